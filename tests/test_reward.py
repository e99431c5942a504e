from __future__ import annotations

import itertools

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_arm.config import RewardConfig
from mjx_arm.reward import Situation, reward_terms

GAMMA = 0.99
LIFT = 0.3


def situation_of(*, distance=0.1, height=0.0, grasped=False):
    return Situation(jnp.float32(distance), jnp.float32(height), jnp.asarray(grasped))


def total(config, *, success=False, before=None, **situation):
    after = situation_of(**situation)
    before = after if before is None else situation_of(**before)
    terms = reward_terms(config, before, after, jnp.asarray(success), LIFT)
    names = {"progress"} if config.kind == "progress" else {"reach", "hold", "lift"}
    assert set(terms) == names | {"success"}
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


@pytest.mark.parametrize(
    ("kind", "hovering_wins"), [("paper", True), ("completion", False), ("progress", False)]
)
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


WAY = [
    {"distance": 0.2},
    {"distance": 0.1},
    {"distance": 0.0},
    {"distance": 0.0, "grasped": True},
    {"distance": 0.0, "grasped": True, "height": 0.15},
    {"distance": 0.0, "grasped": True, "height": 0.29},
]


def test_progress_of_every_way_sums_to_success_and_the_first_potential():
    config = RewardConfig(kind="progress")
    for way in (WAY, WAY[::2], [WAY[0], WAY[4], WAY[1], WAY[5]]):
        steps = itertools.pairwise(way)
        paid = [total(config, before=before, **after) for before, after in steps]
        end = {"distance": 0.0, "grasped": True, "height": 0.3}
        paid.append(total(config, before=way[-1], success=True, **end))
        value = sum(GAMMA**t * reward for t, reward in enumerate(paid))
        # 160 steps a metre, 20 for the grasp: 0.2 m to the cube and 0.3 m up are 100 steps.
        assert value == pytest.approx(100 * (GAMMA ** len(paid[1:]) - GAMMA**100), rel=1e-4)


def test_progress_pays_for_steps_ahead_and_charges_for_steps_back():
    config = RewardConfig(kind="progress")
    for before, after in itertools.pairwise(WAY):
        assert total(config, before=before, **after) > 0
        assert total(config, before=after, **before) < total(config, before=before, **before) < 0


def test_scale_scales_everything():
    for situation in ({"distance": 0.2}, {"grasped": True, "success": True, "height": 0.3}):
        plain = total(RewardConfig(kind="completion"), **situation)
        scaled = total(RewardConfig(kind="completion", scale=0.2), **situation)
        assert scaled == pytest.approx(0.2 * plain)


@pytest.mark.parametrize("name", ["distance_unit", "height_unit", "scale", "distance_decay"])
def test_constants_out_of_their_domain_are_refused(name):
    with pytest.raises(ValueError, match=name):
        RewardConfig(**{name: 0.0})
