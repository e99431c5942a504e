"""What a cube does in the gripper and on the table over 20 s, on both backends."""

from __future__ import annotations

import numpy as np
from physics_lab import HOLDING, RESTING

MOST_SINKING = 0.005
# Sideways as well as down: further than this a cube would be on its way out.
MOST_SLIPPING = 0.005
MOST_CREEP_ON_TABLE = 1e-3
MOST_TURN_ON_TABLE = 1e-3
MOST_DIFFERENCE_OF_BACKENDS = 0.002


def cube(run, state) -> np.ndarray:
    start = run.lab.ids.cube_qpos
    return np.asarray(state.qpos[:, start : start + 7])


def test_the_cubes_were_lifted(long_run):
    heights = cube(long_run, long_run.lifted)[HOLDING, 2]
    assert heights.min() > 0.1


def test_a_held_cube_sinks_little(long_run):
    before, after = cube(long_run, long_run.lifted), cube(long_run, long_run.after)
    sinking = (before - after)[HOLDING, 2]
    assert np.abs(sinking).max() < MOST_SINKING


def test_a_held_cube_does_not_slip_out(long_run):
    lab = long_run.lab
    slip = lab.cube_in_gripper(long_run.after) - lab.cube_in_gripper(long_run.lifted)
    assert np.linalg.norm(slip[HOLDING], axis=-1).max() < MOST_SLIPPING


def test_one_open_drops_the_cube(long_run):
    heights = cube(long_run, long_run.opened)[HOLDING, 2]
    half = long_run.lab.ids.cube_half_size
    np.testing.assert_allclose(heights, half, atol=2e-3)


def test_a_cube_on_the_table_rests_still(long_run):
    before, after = cube(long_run, long_run.at_start), cube(long_run, long_run.after)
    change = np.abs(after - before)[RESTING]
    assert change[:, :3].max() < MOST_CREEP_ON_TABLE
    assert change[:, 3:].max() < MOST_TURN_ON_TABLE
    start = long_run.lab.scene.mj_model.nv - 6
    assert np.abs(np.asarray(long_run.after.qvel)[RESTING, start:]).max() < 1e-3


def test_nothing_diverges(long_run):
    assert not long_run.diverged.any()


def test_a_held_cube_is_where_the_other_backend_has_it(long_runs):
    native, mjx = (
        run.lab.cube_in_gripper(run.after)[HOLDING]
        for run in (long_runs["native"], long_runs["mjx"])
    )
    assert np.linalg.norm(native - mjx, axis=-1).max() < MOST_DIFFERENCE_OF_BACKENDS
