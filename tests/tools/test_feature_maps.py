from __future__ import annotations

import io

import jax
import numpy as np
import pytest
from PIL import Image

from mjx_arm.export import to_observation
from mjx_arm.standin.levels import Offsets, find_level
from mjx_arm.tools import feature_maps
from mjx_arm.tools.feature_maps import (
    compare_moments,
    cosine,
    draw_comparisons,
    make_layer_outputs,
    to_json,
)
from mjx_arm.training.agent import load_agent


def test_cosine_by_hand() -> None:
    assert cosine(np.asarray([1.0, 0]), np.asarray([[3.0], [0]])) == pytest.approx(1)
    assert cosine(np.asarray([1.0, 0]), np.asarray([0, 2.0])) == 0
    assert cosine(np.asarray([3.0, 4]), np.asarray([4.0, 3])) == pytest.approx(24 / 25)
    assert cosine(np.zeros(2), np.ones(2)) == 0


def test_the_outputs_are_those_of_the_network() -> None:
    """The first convolution by jax's own convolution, and the last layer's size."""
    agent = load_agent("agent-a")
    images = np.random.default_rng(0).integers(0, 256, (2, *agent.env.config.size, 3), np.uint8)
    outputs = make_layer_outputs(agent)(images)
    network = agent.config.network
    kernel = agent.params["params"]["PatchConv_0"]["kernel"]
    strides = (network.strides[0],) * 2
    x = images.astype(np.float32) / 255 - 0.5
    x = jax.lax.conv_general_dilated(
        x, kernel, strides, "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )
    pool, (n, h, w, c) = network.pool, x.shape
    x = np.asarray(x)[:, : h // pool * pool, : w // pool * pool]
    x = x.reshape(n, h // pool, pool, w // pool, pool, c).max(axis=(2, 4))
    x = np.maximum(x + agent.params["params"]["PatchConv_0"]["bias"], 0)
    assert outputs["PatchConv_0"] == pytest.approx(x, abs=1e-4)
    assert list(outputs)[:3] == ["PatchConv_0", "PatchConv_1", "PatchConv_2"]
    q = np.asarray(agent.apply(agent.params, to_observation(agent, images)))
    advantages = q - q.mean(axis=-1, keepdims=True)
    assert list(outputs)[-1] == "Q-values"
    assert outputs["Q-values"] == pytest.approx(advantages, abs=1e-4)


def test_the_simulator_shows_the_plain_scene_whatever_training_varied(monkeypatch) -> None:
    agent = load_agent("agent-a", randomisation="standard")
    used = []

    def no_opengl(env, *_, **__):
        used.append(env)
        raise ValueError("no OpenGL")

    monkeypatch.setattr(feature_maps, "_make_episode", lambda agent: used.append(agent.env))
    monkeypatch.setattr(feature_maps, "StandIn", no_opengl)
    with pytest.raises(ValueError, match="no OpenGL"):
        compare_moments(agent, Offsets(), seed=3, episodes=1)
    assert agent.env.randomiser
    assert not used[0].randomiser
    assert used[1] is used[0]


@pytest.mark.slow
@pytest.mark.usefixtures("opengl")
def test_a_moment_in_both_worlds() -> None:
    agent = load_agent("agent-a")
    (same,) = compare_moments(agent, Offsets(), seed=3, episodes=1, shadows=False)
    (other,) = compare_moments(agent, find_level("test"), seed=3, episodes=1)
    assert same.moment == other.moment
    assert np.abs(same.simulated.astype(int) - same.real).mean() < 3
    for one, two in zip(same.layers, other.layers, strict=True):
        assert one.name == two.name
        assert 0.7 < one.similarity <= 1 + 1e-9
        assert two.similarity < one.similarity
        assert np.array_equal(one.simulated, two.simulated)
    report = to_json(other)
    assert len(report["layers"]) == len(other.layers)
    assert len(report["q_simulated"]) == agent.env.num_actions
    picture = Image.open(io.BytesIO(draw_comparisons([("same", same), ("test", other)])))
    assert picture.width > 900
