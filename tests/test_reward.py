from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_arm.config import RewardConfig
from mjx_arm.reward import reward_terms

GAMMA = 0.99
LIFT = 0.3


def total(config, *, distance=0.1, height=0.0, grasped=False, success=False):
    terms = reward_terms(
        config,
        distance=jnp.float32(distance),
        height=jnp.float32(height),
        grasped=jnp.asarray(grasped),
        success=jnp.asarray(success),
        lift=LIFT,
    )
    assert set(terms) == {"reach", "hold", "lift", "success"}
    return float(sum(terms.values()))


@pytest.mark.parametrize(
    ("situation", "expected"),
    [
        ({"distance": 0.0}, 1.0),
        ({"distance": 0.4}, np.exp(-0.25 * 4.0)),
        ({"grasped": True, "height": 0.0}, 1.0),
        ({"grasped": True, "height": 0.2}, 1.2),
        ({"grasped": True, "height": 0.3, "success": True}, 100.0),
    ],
)
def test_paper_is_algorithm_1(situation, expected):
    assert total(RewardConfig(kind="paper"), **situation) == pytest.approx(expected, rel=1e-6)


def test_units_of_the_paper_are_options():
    config = RewardConfig(kind="paper", distance_unit=1.0, height_unit=0.01, distance_decay=0.5)
    assert total(config, distance=2.0) == pytest.approx(np.exp(-1.0))
    assert total(config, grasped=True, height=0.2) == pytest.approx(21.0)


@pytest.mark.parametrize(("kind", "hovering_wins"), [("paper", True), ("completion", False)])
def test_only_the_papers_reward_prefers_to_hover(kind, hovering_wins):
    config = RewardConfig(kind=kind)
    hovering = total(config, grasped=True, height=0.2999) / (1 - GAMMA)
    success = total(config, grasped=True, height=0.3, success=True)
    assert (hovering > success) == hovering_wins


def test_completion_grows_on_the_way():
    config = RewardConfig(kind="completion")
    way = [
        total(config, distance=0.3),
        total(config, distance=0.1),
        total(config, distance=0.0),
        total(config, distance=0.0, grasped=True),
        total(config, distance=0.0, grasped=True, height=0.15),
        total(config, distance=0.0, grasped=True, height=0.29),
    ]
    assert way == sorted(way)
    assert len(set(way)) == len(way)
    assert way[-1] <= 0.8


def test_scale_scales_everything():
    for situation in ({"distance": 0.2}, {"grasped": True, "success": True, "height": 0.3}):
        plain = total(RewardConfig(kind="completion"), **situation)
        scaled = total(RewardConfig(kind="completion", scale=0.2), **situation)
        assert scaled == pytest.approx(0.2 * plain)


@pytest.mark.parametrize("name", ["distance_unit", "height_unit", "scale", "distance_decay"])
def test_constants_out_of_their_domain_are_refused(name):
    with pytest.raises(ValueError, match=name):
        RewardConfig(**{name: 0.0})
