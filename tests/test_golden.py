"""A few steps of two environments, against `golden.json`.

`python tests/test_golden.py` writes it anew.
"""

from __future__ import annotations

import json
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_arm

GOLDEN = pathlib.Path(__file__).parent / "golden.json"
ACTIONS = [3, 3, 5, 8, 13, 2, 12, 11, 6, 1]
# Another machine may round a pixel on an edge to the other side.
PIXELS = 3


def play() -> dict[str, list]:
    env = mjx_arm.make("B", physics="native", observation="packed")
    reset, step = jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))
    keys = jax.random.split(jax.random.key(42), 2)
    obs, state = reset(keys)
    rewards = []
    for action in ACTIONS:
        obs, state, reward, *_ = step(keys, state, jnp.full(2, action))
        rewards.append(np.asarray(reward, float).round(6).tolist())
    ids = np.asarray(mjx_arm.segmentation(obs))
    geoms = range(env.scene.mj_model.ngeom)
    return {
        "rewards": rewards,
        "qpos": np.asarray(state.physics.qpos, float).round(5).tolist(),
        "pixels": [[int((image == geom).sum()) for geom in geoms] for image in ids],
        "colour": np.asarray(mjx_arm.rgb(obs), float).mean(axis=(1, 2)).round(2).tolist(),
    }


@pytest.mark.usefixtures("optimised")
def test_a_few_steps_are_what_they_were():
    golden, now = json.loads(GOLDEN.read_text()), play()
    np.testing.assert_allclose(now["rewards"], golden["rewards"], atol=1e-4)
    np.testing.assert_allclose(now["qpos"], golden["qpos"], atol=1e-4)
    np.testing.assert_allclose(now["pixels"], golden["pixels"], atol=PIXELS)
    np.testing.assert_allclose(now["colour"], golden["colour"], atol=0.1)


if __name__ == "__main__":
    GOLDEN.write_text(json.dumps(play(), indent=1) + "\n")
