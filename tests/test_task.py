from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from rollouts import make_pushing_policy, random_policy, rollout

import mjx_arm
from mjx_arm.scripted import make_scripted_policy
from mjx_arm.task import CLOSE, NUM_ACTIONS, OPEN, apply_action

# A force that counts as a touch, N; the cube weighs 0.8 N.
TOUCH_FORCE = 0.1
LEAST_PRECISION = 0.98
LEAST_RECALL = 0.98


@pytest.fixture(scope="module")
def env():
    return mjx_arm.make("B", physics="native", observation="state", cube_moves="always")


def test_there_are_fourteen_actions(env):
    assert env.num_actions == NUM_ACTIONS == 14


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize(("offset", "sign"), [(0, -1.0), (1, 1.0)])
def test_two_actions_turn_each_joint_by_one_degree(env, joint, offset, sign):
    ctrl = jnp.asarray(env.ids.home_ctrl)
    after = apply_action(env.ids, ctrl, jnp.int32(2 * joint + offset), 1.0)
    change = np.rad2deg(np.asarray(after - ctrl))
    expected = np.zeros(len(ctrl))
    expected[env.ids.arm_ctrl[joint]] = sign
    np.testing.assert_allclose(change, expected, atol=1e-4)


def test_open_and_close_set_the_full_target(env):
    low, high = env.ids.ctrl_range[env.ids.gripper_ctrl]
    ctrl = jnp.asarray(env.ids.home_ctrl)
    shut = apply_action(env.ids, ctrl, jnp.int32(CLOSE), 1.0)
    opened = apply_action(env.ids, shut, jnp.int32(OPEN), 1.0)
    assert shut[env.ids.gripper_ctrl] == low
    assert opened[env.ids.gripper_ctrl] == high
    np.testing.assert_array_equal(shut[env.ids.arm_ctrl], ctrl[env.ids.arm_ctrl])


def test_targets_are_clipped_to_the_range_of_the_joint(env):
    low, high = env.ids.ctrl_range.T
    np.testing.assert_array_equal(apply_action(env.ids, jnp.asarray(high), jnp.int32(1), 1.0), high)
    np.testing.assert_array_equal(apply_action(env.ids, jnp.asarray(low), jnp.int32(0), 1.0), low)


def test_travel_of_the_gripper_takes_at_most_five_iterations(env):
    _, state = jax.jit(env.reset)(jax.random.key(0))
    transition = jax.jit(env.transition)
    for action in (CLOSE, OPEN):
        for _ in range(5):
            state, _ = transition(state, action)
        fingers = state.physics.qpos[env.ids.finger_qpos]
        target = state.ctrl[env.ids.gripper_ctrl]
        np.testing.assert_allclose(fingers, target, atol=0.001)


def finger_forces(env, states) -> np.ndarray:
    """Sums of the contact forces of each finger on the cube, by MuJoCo C: `[L * N, 2]`, N."""
    model, pads = env.scene.mj_model, [set(row) for row in env.ids.pad_geoms]
    data, force = mujoco.MjData(model), np.zeros(6)
    qpos = states.physics.qpos.reshape(-1, model.nq)
    qvel = states.physics.qvel.reshape(-1, model.nv)
    ctrl = states.ctrl.reshape(-1, model.nu)
    totals = np.zeros((len(qpos), 2))
    for row in range(len(qpos)):
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[row], qvel[row], ctrl[row]
        mujoco.mj_forward(model, data)
        for index in range(data.ncon):
            geoms = set(data.contact[index].geom)
            for finger in range(2):
                if env.ids.cube_geom in geoms and geoms & pads[finger]:
                    mujoco.mj_contactForce(model, data, index, force)
                    totals[row, finger] += force[0]
    return totals


def test_grasped_agrees_with_the_contact_forces(env):
    scripted = make_scripted_policy(env)
    held = mjx_arm.make("B", physics="native", observation="state", start="in_grasp")
    cases = {
        "scripted": (env, lambda key, state: scripted(state)),
        "random": (held, random_policy),
        "pushing": (env, make_pushing_policy(scripted)),
    }
    predicted, actual = [], []
    for used, policy in cases.values():
        states, transitions = rollout(used, policy, num_envs=32, length=250, seed=5)
        predicted.append(transitions.info["grasped"].reshape(-1))
        actual.append((finger_forces(used, states) > TOUCH_FORCE).all(axis=1))
        assert actual[-1].sum() > 200
    predicted, actual = np.concatenate(predicted), np.concatenate(actual)
    both = (predicted & actual).sum()
    assert both / predicted.sum() >= LEAST_PRECISION
    assert both / actual.sum() >= LEAST_RECALL


def test_a_shut_gripper_on_top_of_the_cube_has_not_grasped_it(env):
    model, ids = env.scene.mj_model, env.ids
    qpos = ids.home_qpos.copy()
    qpos[ids.finger_qpos] = ids.ctrl_range[ids.gripper_ctrl, 0]
    _, state = env.reset(jax.random.key(0))
    from mjx_arm.kinematics import make_kinematics
    from mjx_arm.task import grasped

    poses = make_kinematics(model)(jnp.asarray(qpos))
    lowest = (
        float(np.min(poses.geom_xpos[ids.pad_geoms, 2])) - model.geom_size[ids.pad_geoms[0, 0], 0]
    )
    cube = poses.geom_xpos.at[ids.cube_geom].set(
        poses.site_xpos[ids.grasp_site].at[2].set(lowest - ids.cube_half_size + 1e-4)
    )
    poses = poses.replace(geom_xpos=cube)
    shut = state.ctrl.at[ids.gripper_ctrl].set(ids.ctrl_range[ids.gripper_ctrl, 0])
    assert not grasped(model, ids, poses, shut)
