from __future__ import annotations

import json
import pathlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

from mjx_arm.cli import main
from mjx_arm.export import export_policy, policy_function
from mjx_arm.policy import Policy
from mjx_arm.render.packing import NO_GEOM, pack
from mjx_arm.training.agent import load_agent

ALONE = """
import json, sys
import numpy as np
import jax
from jax import export

path, images, out = sys.argv[1:]
with open(path, "rb") as file:
    policy = jax.jit(export.deserialize(bytearray(file.read())).call)
results = [policy(image) for image in np.load(images)]
np.savez(out, q=[q for q, _ in results], action=[action for _, action in results])
loaded = {name.split(".")[0] for name in sys.modules}
print(json.dumps(sorted(loaded & {"flatbuffers", "flax", "mjx_arm", "mujoco", "optax"})))
"""


@pytest.fixture(scope="module")
def agent():
    return load_agent("agent-b")


def images_of(agent, count: int) -> np.ndarray:
    """Random poses of the scene, and noise."""
    env = agent.env
    render = jax.jit(jax.vmap(lambda key: env.reset(key)[0]))
    packed = np.asarray(render(jax.random.split(jax.random.key(3), count // 2)))
    seen = np.stack([packed >> shift & 255 for shift in (0, 8, 16)], axis=-1).astype(np.uint8)
    noise = np.random.default_rng(0).integers(
        0, 256, (count - len(seen), *seen.shape[1:]), np.uint8
    )
    return np.concatenate([seen, noise])


def test_the_exported_policy_is_the_original_where_only_jax_and_flatbuffers_are(
    agent, tmp_path: pathlib.Path
) -> None:
    """On 1,000 images, in another process."""
    path = tmp_path / "policy.bin"
    assert main(["export", "agent-b", "--out", str(path)]) == 0
    images = images_of(agent, 1_000)
    np.save(tmp_path / "images.npy", images)
    command = [sys.executable, "-c", ALONE, str(path)]
    files = [str(tmp_path / "images.npy"), str(tmp_path / "out.npz")]
    done = subprocess.run([*command, *files], check=True, capture_output=True, text=True)
    assert json.loads(done.stdout) == ["flatbuffers"]
    found = np.load(tmp_path / "out.npz")
    original = jax.jit(agent.q_values)
    packed = pack(*(images[..., i].astype(np.uint32) for i in range(3)), np.uint32(NO_GEOM))
    q = np.stack([original(jnp.asarray(x)) for x in packed])
    assert found["q"].dtype == np.float32
    assert found["action"].dtype == np.int32
    assert np.abs(found["q"] - q).max() <= 1e-5 * np.abs(q).max()
    assert np.array_equal(found["action"], found["q"].argmax(axis=-1))
    assert np.mean(found["action"] == q.argmax(axis=-1)) == 1.0


def test_a_policy_checks_its_images(agent) -> None:
    policy = Policy(export_policy(agent))
    assert policy.image_shape == (*agent.env.config.size, 3)
    assert policy.num_actions == agent.env.num_actions
    image = np.zeros(policy.image_shape, np.uint8)
    q, action = policy(image)
    expected, best = policy_function(agent)(jnp.asarray(image))
    assert q == pytest.approx(np.asarray(expected), abs=1e-5)
    assert action == int(best)
    for wrong in (image[:-1], image.astype(np.float32), image.tolist()):
        with pytest.raises(ValueError, match="an image must be"):
            policy(wrong)


@pytest.mark.parametrize("data", [b"", b"nothing", b"\x00" * 64, bytes(range(256)) * 8])
def test_other_bytes_are_no_policy(data) -> None:
    with pytest.raises(ValueError, match=r"x\.bin is no exported policy") as error:
        Policy(data, "x.bin")
    assert "\n" not in str(error.value)


def test_the_export_of_another_function_is_no_policy() -> None:
    def policy(image: jax.Array) -> tuple[jax.Array, jax.Array]:
        return image[0, 0], jnp.argmax(image[0, 0])

    image = jax.ShapeDtypeStruct((4, 4, 3), jnp.float32)
    data = bytes(export.export(jax.jit(policy))(image).serialize())
    with pytest.raises(ValueError, match=r"is no exported policy .*its input is of type float32"):
        Policy(data)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--format", "tflite"], "--format must be one of stablehlo, onnx, got 'tflite'"),
        (["--format", "onnx", "--out", "x.onnx"], "ONNX needs jax2onnx"),
        (["--out", "none/policy.bin"], "give a file in a folder that exists"),
        (["--out", "."], "give a file in a folder that exists"),
    ],
)
def test_what_cannot_be_exported_is_one_sentence(
    options, sentence, capsys, tmp_path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    if "onnx" in options:
        monkeypatch.setitem(sys.modules, "jax2onnx", None)
    assert main(["export", "agent-a", *options]) == 2
    error = capsys.readouterr().err
    assert sentence in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
