from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest

from mjx_arm.scene import load_scene
from mjx_arm.standin.levels import (
    LEVELS,
    Offsets,
    colour_matrix,
    find_level,
    offset_model,
    sample_signs,
)

# m, degrees, share, share, share, iterations, share.
TABLE = {
    "near": (0.01, 1.0, 0.05, 0.10, 0.05, 0, 0.0),
    "medium": (0.03, 3.0, 0.10, 0.20, 0.10, 1, 0.10),
    "far": (0.06, 6.0, 0.20, 0.40, 0.20, 2, 0.10),
}


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return load_scene("arm_cube").mj_model


@pytest.mark.parametrize("level", TABLE)
def test_the_levels_are_those_of_the_table(level: str) -> None:
    assert dataclasses.astuple(find_level(level))[:-1] == TABLE[level]


def test_an_unknown_level_is_rejected_by_name() -> None:
    with pytest.raises(ValueError, match=r"unknown level 'nears': did you mean 'near'\?"):
        find_level("nears")


@pytest.mark.parametrize("level", TABLE)
def test_a_model_has_the_offsets_of_its_level(level: str, model: mujoco.MjModel) -> None:
    shift, degrees, _, dynamics, gain, _, _ = TABLE[level]
    moved = offset_model(model, find_level(level))
    assert np.linalg.norm(moved.cam_pos - model.cam_pos, axis=-1) == pytest.approx(shift)
    dots = np.abs(np.sum(moved.cam_quat * model.cam_quat, axis=-1))
    assert np.rad2deg(2 * np.arccos(dots)) == pytest.approx(degrees, rel=1e-6)
    friction = moved.pair_friction / model.pair_friction
    assert np.unique(friction.round(9)).tolist() in ([1 - dynamics], [1 + dynamics])
    bodies = model.body_mass > 0
    masses = moved.body_mass[bodies] / model.body_mass[bodies]
    assert sorted(set(masses.round(9))) == pytest.approx([1 - dynamics, 1 + dynamics])
    inertias = moved.body_inertia[bodies] / model.body_inertia[bodies]
    assert inertias == pytest.approx(np.repeat(masses[:, None], 3, axis=1))
    assert moved.actuator_gainprm[:, 0] == pytest.approx((1 - gain) * model.actuator_gainprm[:, 0])
    assert moved.actuator_biasprm[:, 1] == pytest.approx(-moved.actuator_gainprm[:, 0])
    assert np.array_equal(moved.actuator_biasprm[:, 2], model.actuator_biasprm[:, 2])
    # What MuJoCo derives from masses is derived again.
    assert moved.body_subtreemass[0] == pytest.approx(moved.body_mass.sum())


def test_the_model_itself_stays_as_it_is(model: mujoco.MjModel) -> None:
    before = model.cam_pos.copy(), model.body_mass.copy(), model.pair_friction.copy()
    offset_model(model, find_level("far"))
    after = model.cam_pos, model.body_mass, model.pair_friction
    assert all(np.array_equal(x, y) for x, y in zip(before, after, strict=True))


def test_no_offsets_leave_a_model_as_it_is(model: mujoco.MjModel) -> None:
    same = offset_model(model, Offsets())
    for name in ("cam_pos", "cam_quat", "pair_friction", "body_mass", "actuator_gainprm"):
        assert np.array_equal(getattr(same, name), getattr(model, name)), name
    assert np.allclose(colour_matrix(Offsets(), model.nbody), np.eye(3))


def test_the_levels_share_their_signs_and_the_level_of_the_tests_has_others() -> None:
    signs = {name: sample_signs(LEVELS[name], 12) for name in LEVELS}

    def flat(name: str) -> list[int]:
        parts = dataclasses.astuple(signs[name])
        return np.concatenate([np.atleast_1d(part) for part in parts]).tolist()

    assert flat("near") == flat("medium") == flat("far") != flat("test")
    assert set(flat("near")) == {1, -1}


@pytest.mark.parametrize(("level", "share"), [("near", 0.05), ("far", 0.2)])
def test_colours_are_turned_and_made_brighter_or_darker(level: str, share: float) -> None:
    matrix = colour_matrix(find_level(level), 12).astype(float)
    grey = matrix @ np.ones(3)
    assert np.abs(grey - 1) == pytest.approx(np.full(3, share), abs=1e-6)
    red = matrix @ [1.0, 0, 0] / grey[0]
    axis = np.ones(3) / np.sqrt(3)
    before, after = np.asarray([1.0, 0, 0]) - axis[0] * axis, red - (red @ axis) * axis
    cosine = before @ after / np.linalg.norm(before) / np.linalg.norm(after)
    assert np.rad2deg(np.arccos(cosine)) == pytest.approx(360 * share, rel=1e-4)
