"""A trained policy as a file for other programs: StableHLO or ONNX.

The program takes one image and returns Q-values and the best action. An image is
`[H, W, 3] uint8`, red, green, blue; of several cameras `[C, H, W, 3] uint8`. Q-values are
`[A] float32`. The action is `[] int32`: `2 j` and `2 j + 1` move joint `j` by minus and plus one
degree, the last two open and close the gripper.
"""

from __future__ import annotations

import os
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import export

from mjx_arm.options import check_name
from mjx_arm.render.packing import NO_GEOM, pack
from mjx_arm.training.agent import Agent

FORMATS = ("stablehlo", "onnx")
# What a StableHLO file runs on.
_PLATFORMS = ("cpu", "cuda")


def image_shape(agent: Agent) -> tuple[int, ...]:
    """Shape of the image that an agent sees, `(H, W, 3)` or `(C, H, W, 3)`.

    Raises:
      ValueError: the agent sees no image.
    """
    config = agent.env.config
    if config.observation not in ("packed", "rgb"):
        raise ValueError(
            f"only an agent that sees pixels can be exported, and this one observes "
            f"{config.observation!r}"
        )
    cameras = () if len(config.cameras) == 1 else (len(config.cameras),)
    return (*cameras, *config.size, 3)


def policy_function(agent: Agent) -> Callable[[jax.Array], tuple[jax.Array, jax.Array]]:
    """The policy of an agent that sees pixels: `image -> (Q-values, action)`; see the module."""

    def policy(image: jax.Array) -> tuple[jax.Array, jax.Array]:
        q = agent.q_values(to_observation(agent, image))
        return q, jnp.argmax(q).astype(jnp.int32)

    return policy


def to_observation(agent: Agent, images: jax.Array) -> jax.Array:
    """Images `[..., 3] uint8` as the observations of an agent that sees pixels.

    Packed pixels get no geom ids: a camera does not know them.
    """
    if agent.env.config.observation != "packed":
        return images
    red, green, blue = (images[..., i].astype(jnp.uint32) for i in range(3))
    return pack(red, green, blue, jnp.full(red.shape, NO_GEOM, jnp.uint32))


def export_policy(agent: Agent) -> bytes:
    """The policy of an agent as StableHLO, for `mjx_arm.policy.Policy` or `jax.export.deserialize`.

    Raises:
      ValueError: the agent sees no image.
    """
    image = jax.ShapeDtypeStruct(image_shape(agent), jnp.uint8)
    exported = export.export(jax.jit(policy_function(agent)), platforms=_PLATFORMS)(image)
    return bytes(exported.serialize())


def export_onnx(agent: Agent) -> bytes:
    """The policy of an agent as an ONNX model with input `image`, outputs `q_values` and `action`.

    Args:
      agent: loaded with `convolution="nn.Conv"`, whose convolutions ONNX knows.

    Raises:
      ValueError: jax2onnx is not installed, or the agent sees no image.
    """
    image = jax.ShapeDtypeStruct(image_shape(agent), jnp.uint8)
    try:
        import jax2onnx
    except ImportError as error:
        raise ValueError(
            "ONNX needs jax2onnx, which excludes versions that training needs: `make onnx` builds "
            "an environment for it, then .venv-onnx/bin/mjx-arm export has --format onnx"
        ) from error
    model: Any = jax2onnx.to_onnx(
        policy_function(agent),
        [image],
        model_name="policy",
        input_names=["image"],
        output_names=["q_values", "action"],
    )
    return bytes(model.SerializeToString())


def write_policy(agent: Agent, path: pathlib.Path, form: str = "stablehlo") -> None:
    """Writes the policy of an agent to a file: whole, or not at all.

    Args:
      agent: the agent; for ONNX see `export_onnx`.
      path: of the file; its folder must be there.
      form: `stablehlo` or `onnx`.

    Raises:
      ValueError: an unknown form, a path that cannot be written, or see `export_policy`.
    """
    check_name("format", form, FORMATS)
    check_path(path)
    data = export_policy(agent) if form == "stablehlo" else export_onnx(agent)
    part = path.with_name(f"{path.name}.part")
    try:
        part.write_bytes(data)
        os.replace(part, path)
    except OSError as error:
        raise ValueError(f"{path} could not be written: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)


def check_path(path: pathlib.Path) -> None:
    """Checks that a file can be written to a path.

    Raises:
      ValueError: the path is a folder, or its folder is not there.
    """
    if path.is_dir() or not path.absolute().parent.is_dir():
        raise ValueError(f"{path} cannot be written: give a file in a folder that exists")
