"""A video of a policy: the scene, and beside it what the agent sees."""

from __future__ import annotations

import dataclasses
import os
import pathlib
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mjx_arm.algos.collect import act
from mjx_arm.algos.exploration import check_epsilon
from mjx_arm.envs.auto_reset import AutoReset
from mjx_arm.envs.env import Env
from mjx_arm.kinematics import make_kinematics
from mjx_arm.physics import compiler_options
from mjx_arm.render import rgb
from mjx_arm.varies import Params

_EDGE = 384
_FRAMES_PER_SECOND = 30
_FONT_SIZE = 15
# Frames rendered in one call.
_AT_ONCE = 50


@dataclasses.dataclass(frozen=True)
class Episode:
    """One recorded episode of length `L - 1`.

    Attributes:
      qpos: `[L, nq] float32`, before each step and after the last.
      shown: `[L, nq] float32`, what the images of these states show: earlier ones, if delayed.
      max_q: `[L] float32`, the largest Q-value in each of these states.
      params: values of the model's fields that vary by episode.
      success: it ended in success.
    """

    qpos: np.ndarray
    shown: np.ndarray
    max_q: np.ndarray
    params: Params
    success: bool

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.qpos)


def record_episode(
    env: Env,
    apply: Callable[[Any, jax.Array], jax.Array],
    params: Any,
    *,
    epsilon: float,
    key: jax.Array,
) -> Episode:
    """Runs an epsilon-greedy policy for one episode.

    Raises:
      ValueError: `epsilon` outside 0 to 1.
    """
    check_epsilon(epsilon)
    auto = AutoReset(env)

    def step(
        carry: tuple[Any, jax.Array, jax.Array], _: None
    ) -> tuple[tuple[Any, jax.Array, jax.Array], tuple[jax.Array, ...]]:
        envs, key, running = carry
        key, act_key = jax.random.split(key)
        obs: Any = jax.vmap(env.observe)(envs.env)
        q = apply(params, obs)
        _action, after, transition = act(auto, act_key, envs, q, jnp.float32(epsilon))
        ended = (transition.terminated | transition.truncated)[0]
        shown = jax.vmap(env.shown_qpos)(envs.env)[0]
        seen = (envs.env.physics.qpos[0], shown, jnp.max(q), running)
        return (after, key, running & ~ended), (*seen, running & transition.terminated[0])

    def run(key: jax.Array) -> tuple[Any, ...]:
        reset_key, key = jax.random.split(key)
        _, envs = jax.vmap(auto.reset)(reset_key[None])
        carry = (envs, key, jnp.ones((), jnp.bool_))
        # One step more than the longest episode: its state is the last one of the episode.
        _, records = jax.lax.scan(step, carry, None, length=env.config.max_steps + 1)
        return jax.tree.map(lambda x: x[0], envs.env.params), *records

    compiled = jax.jit(run, compiler_options=compiler_options(env.physics))
    episode_params, qpos, shown, max_q, running, success = jax.device_get(compiled(key))
    frames = int(running.sum()) + 1
    return Episode(
        qpos[:frames], shown[:frames], max_q[:frames], episode_params, bool(success.any())
    )


def render_episode(env: Env, episode: Episode) -> Iterator[np.ndarray]:
    """Renders an episode: the scene with shadows, and beside it what the agent sees.

    Labels name both sides, the step, the largest Q-value and, at the end, the result.

    Yields:
      Each of its frames, `[384, 768, 3] uint8`. Some are rendered at a time, because 1,000 would
      take a gigabyte.
    """
    kinematics = make_kinematics(env.scene.mj_model, env.varies)
    size = (_EDGE, _EDGE)
    large = env.with_cameras(size=size, shadows=True)

    def render(qpos: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, ...]:
        images = (
            x.render(now, kinematics(now, episode.params), episode.params)[0]
            for x, now in zip((large, env), qpos, strict=True)
        )
        return tuple(rgb(_first_camera(image, env)) for image in images)

    render_some = jax.jit(lambda *qpos: jax.lax.map(render, qpos))
    rows, columns = (np.arange(_EDGE) * edge // _EDGE for edge in env.config.size)
    for start in range(0, len(episode.qpos), _AT_ONCE):
        parts = [x[start : start + _AT_ONCE] for x in (episode.qpos, episode.shown)]
        count = len(parts[0])
        # All parts have one length: another length would compile again.
        padded = [np.concatenate([x, np.repeat(x[-1:], _AT_ONCE - count, axis=0)]) for x in parts]
        scenes, views = jax.device_get(render_some(*padded))
        for i, (scene, view) in enumerate(zip(scenes[:count], views, strict=False)):
            frame = np.concatenate([scene, view[rows][:, columns]], axis=1)
            yield _label(frame, env, episode, start + i)


def _label(frame: np.ndarray, env: Env, episode: Episode, step: int) -> np.ndarray:
    """The frame with its labels."""
    height, width = env.config.size
    status = f"step {step}   max Q {episode.max_q[step]:.2f}"
    if step == len(episode) - 1:
        status += "   success" if episode.success else "   failed"
    image = Image.fromarray(frame)
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(_FONT_SIZE)
    labels = (
        ((6, 4), "scene"),
        ((_EDGE + 6, 4), f"what the agent sees, {width} by {height} pixels"),
        ((6, _EDGE - _FONT_SIZE - 8), status),
    )
    for place, text in labels:
        draw.text(place, text, fill="white", stroke_width=2, stroke_fill="black", font=font)
    return np.asarray(image)


def _first_camera(image: jax.Array, env: Env) -> jax.Array:
    return image if len(env.cameras) == 1 else image[0]


def check_video_path(path: pathlib.Path) -> None:
    """Rejects a path that `write_video` could not write to.

    Raises:
      ValueError: its ending is neither `.mp4` nor `.gif`, or its folder is not there.
    """
    if path.suffix not in (".mp4", ".gif"):
        raise ValueError(f"{path} ends in {path.suffix!r}: give a path ending in .mp4 or .gif")
    if path.is_dir() or not path.absolute().parent.is_dir():
        raise ValueError(f"{path} cannot be written: give a file in a folder that exists")


def write_video(path: pathlib.Path, frames: Iterable[np.ndarray]) -> None:
    """Writes frames `[H, W, 3] uint8` as MP4 or GIF, by the ending of `path`: whole, or not at all.

    Raises:
      ValueError: another ending, or it could not be written.
    """
    check_video_path(path)
    # Without this, the encoder is forked from a process with many threads, and may deadlock.
    os.environ.setdefault("IMAGEIO_FFMPEG_NO_PREVENT_SIGINT", "1")
    import imageio.v2 as imageio

    options: dict[str, Any] = {"fps": _FRAMES_PER_SECOND, "macro_block_size": 16}
    if path.suffix == ".gif":
        options = {"duration": 1000 / _FRAMES_PER_SECOND, "loop": 0}
    part = path.with_name(f"{path.stem}.part{path.suffix}")
    try:
        writer: Any
        with imageio.get_writer(part, **options) as writer:
            for frame in frames:
                writer.append_data(frame)
        part.replace(path)
    except OSError as error:
        # imageio's message about its encoder has many lines.
        reason = str(error.strerror or error).splitlines()[0]
        raise ValueError(f"{path} could not be written: {reason}") from error
    finally:
        part.unlink(missing_ok=True)
