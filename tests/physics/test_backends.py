"""What both backends promise, and how closely they agree."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from physics_lab import NUM_ENVS, Lab

from mjx_arm.physics import compiler_options, make_physics

MOST_ANGLE_DIFFERENCE = 0.05
MOST_PLACE_DIFFERENCE = 1e-3
POSE_TOLERANCE = 2e-6


def random_controls(lab: Lab, length: int, seed: int) -> np.ndarray:
    """One joint a step, by one degree: `[length, N, nu]`."""
    random = np.random.default_rng(seed)
    steps = np.zeros((length, NUM_ENVS, len(lab.ids.home_ctrl)))
    time, env = np.mgrid[:length, :NUM_ENVS]
    joint = lab.ids.arm_ctrl[random.integers(0, 6, (length, NUM_ENVS))]
    steps[time, env, joint] = np.deg2rad(random.choice([-1.0, 1.0], (length, NUM_ENVS)))
    return lab.home()[1] + np.cumsum(steps, axis=0)


def plain_poses(model: mujoco.MjModel, qpos: np.ndarray) -> tuple[np.ndarray, ...]:
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return data.geom_xpos, data.geom_xmat.reshape(-1, 3, 3), data.site_xpos


def assert_poses_belong_to_qpos(lab: Lab, state) -> None:
    for row in range(NUM_ENVS):
        expected = plain_poses(lab.scene.mj_model, np.asarray(state.qpos[row], np.float64))
        actual = (state.poses.geom_xpos, state.poses.geom_xmat, state.poses.site_xpos)
        for one, other in zip(actual, expected, strict=True):
            np.testing.assert_allclose(one[row], other, atol=POSE_TOLERANCE)


def test_poses_belong_to_the_returned_qpos(lab):
    qpos, ctrl = lab.home()
    before = lab.init(qpos, ctrl)
    assert_poses_belong_to_qpos(lab, before)
    ctrl[:, lab.ids.arm_ctrl] += np.deg2rad(1.0)
    after = lab.step(before, ctrl)
    assert_poses_belong_to_qpos(lab, after)
    moved = np.abs(np.asarray(after.poses.site_xpos - before.poses.site_xpos)).max()
    assert moved > 100 * POSE_TOLERANCE, "poses that lag would pass"


def test_backends_agree_before_contact(labs):
    controls = random_controls(labs["native"], 200, seed=3)
    states = {name: lab.init(*lab.home()) for name, lab in labs.items()}
    for ctrl in controls:
        states = {name: lab.step(states[name], ctrl) for name, lab in labs.items()}
        native, mjx = states["native"], states["mjx"]
        angles = (native.qpos - mjx.qpos)[:, labs["native"].ids.arm_qpos]
        places = native.poses.geom_xpos - mjx.poses.geom_xpos
        assert np.rad2deg(np.abs(angles)).max() < MOST_ANGLE_DIFFERENCE
        assert np.linalg.norm(places, axis=-1).max() < MOST_PLACE_DIFFERENCE
    moved = np.asarray(states["native"].qpos[:, labs["native"].ids.arm_qpos])
    assert np.rad2deg(moved.std(axis=0)).min() > 2.0, "the arms should have gone apart"


def test_a_poisoned_state_ends_its_own_episode_only(lab, in_empty_folder, capfd):
    qpos, ctrl = lab.home()
    sane = lab.step(lab.init(qpos, ctrl), ctrl)
    poisoned = {2: np.nan, 5: np.inf, 7: 1e20}
    if lab.physics.backend == "native":
        words = np.array(sane.integration)
        first = 1 + lab.scene.mj_model.nq
        for row, value in poisoned.items():
            words[row].view(np.float64)[first] = value
        sick = sane.replace(integration=jnp.asarray(words))
    else:
        qvel = np.array(sane.qvel)
        for row, value in poisoned.items():
            qvel[row, 0] = value
        sick = sane.replace(qvel=jnp.asarray(qvel))
    expected, actual = lab.step(sane, ctrl), lab.step(sick, ctrl)
    diverged = np.asarray(actual.diverged)
    assert set(np.flatnonzero(diverged)) == set(poisoned)
    assert not np.asarray(expected.diverged).any()
    for one, other in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(one[~diverged], other[~diverged])
    for leaf in (actual.qpos, *jax.tree.leaves(actual.poses)):
        assert np.isfinite(leaf).all()
    np.testing.assert_array_equal(actual.qpos[diverged], sane.qpos[diverged])
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("backend", ["native", pytest.param("mjx", marks=pytest.mark.slow)])
def test_nested_vmap_gives_the_same_as_flat(labs, backend):
    lab = labs[backend]
    qpos, _ = lab.home()
    ctrl = random_controls(lab, 3, seed=1)
    flat = lab.init(qpos, ctrl[0])
    nested = jax.tree.map(lambda x: x.reshape(3, NUM_ENVS // 3, *x.shape[1:]), flat)
    options = compiler_options(lab.physics)
    step = jax.jit(jax.vmap(jax.vmap(lab.physics.step)), compiler_options=options)
    for row in ctrl:
        flat = lab.step(flat, row)
        nested = step(nested, jnp.asarray(row, jnp.float32).reshape(3, NUM_ENVS // 3, -1))
    # XLA may round a batch of another shape otherwise; MuJoCo C does not know of batches.
    tolerance = 0.0 if backend == "native" else 1e-5
    np.testing.assert_allclose(
        nested.qpos.reshape(NUM_ENVS, -1), flat.qpos, rtol=0.0, atol=tolerance
    )
    assert np.unique(np.asarray(flat.qpos), axis=0).shape[0] > NUM_ENVS // 2


def test_auto_is_native_on_cpu(scene):
    expected = "native" if jax.default_backend() == "cpu" else "mjx"
    assert make_physics(scene.mj_model, substeps=2).backend == expected


def test_unknown_backend_is_rejected(scene):
    with pytest.raises(ValueError, match="unknown physics 'bullet': give one of auto, mjx"):
        make_physics(scene.mj_model, "bullet", substeps=2)


def test_only_mjx_on_cpu_is_compiled_in_its_own_way(labs):
    slow = jax.default_backend() == "cpu" and jax.__version__.startswith("0.10.")
    assert bool(compiler_options(labs["mjx"].physics)) == slow
    assert not compiler_options(labs["native"].physics)
