from __future__ import annotations

import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_arm
from mjx_arm.envs.arm import Arm, apply_action, resolve_arm

SCENE = pathlib.Path(__file__).parents[2] / "xml" / "arm_cube.xml"

# A lift on rails: a slide and a hinge, which no shipped scene has beside each other.
CRANE = """
<mujoco>
  <worldbody>
    <body>
      <joint name="rail" type="slide" axis="1 0 0" range="-0.5 0.5"/>
      <geom size="0.1"/>
      <body>
        <joint name="boom" type="hinge" axis="0 1 0" range="-90 90"/>
        <geom size="0.1"/>
        <site name="grasp"/>
        <body>
          <joint name="left_finger" type="slide" axis="0 1 0" range="0 0.05"/>
          <geom size="0.01"/>
        </body>
        <body>
          <joint name="right_finger" type="slide" axis="0 -1 0" range="0 0.05"/>
          <geom size="0.01"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="rail" joint="rail" kp="100" inheritrange="1"/>
    <position name="gripper" joint="left_finger" kp="100" inheritrange="1"/>
    <position name="boom" joint="boom" kp="100" inheritrange="1"/>
  </actuator>
  <keyframe><key name="home"/></keyframe>
</mujoco>
"""


@pytest.fixture(scope="module")
def env():
    return mjx_arm.make("B", physics="native", observation="state", placement="always")


def crane(tmp_path: pathlib.Path, *changes: tuple[str, str]) -> Arm:
    text = CRANE
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path = tmp_path / "crane.xml"
    path.write_text(text)
    return resolve_arm(mjx_arm.load_scene(path))


def act(arm: Arm, ctrl, action: int) -> np.ndarray:
    return np.asarray(apply_action(arm, jnp.asarray(ctrl), jnp.int32(action), 1.0, 5.0))


def test_there_are_fourteen_actions(env):
    assert env.num_actions == env.arm.num_actions == 14


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize(("offset", "sign"), [(0, -1.0), (1, 1.0)])
def test_two_actions_turn_each_joint_by_one_degree(env, joint, offset, sign):
    ctrl = env.arm.home_ctrl
    change = np.rad2deg(act(env.arm, ctrl, 2 * joint + offset) - ctrl)
    expected = np.zeros(len(ctrl))
    expected[env.arm.ctrl[joint]] = sign
    np.testing.assert_allclose(change, expected, atol=1e-4)


def test_open_and_close_set_the_full_target(env):
    arm = env.arm
    low, high = arm.ctrl_range[arm.gripper_ctrl]
    ctrl = arm.home_ctrl
    closed = act(arm, ctrl, arm.close_action)
    opened = act(arm, closed, arm.open_action)
    assert closed[arm.gripper_ctrl] == low
    assert opened[arm.gripper_ctrl] == high
    np.testing.assert_array_equal(closed[arm.ctrl], ctrl[arm.ctrl])


def test_targets_are_clipped_to_the_range_of_the_joint(env):
    low, high = env.arm.ctrl_range.T
    np.testing.assert_array_equal(act(env.arm, high, 1), high)
    np.testing.assert_array_equal(act(env.arm, low, 0), low)


def test_travel_of_the_gripper_takes_at_most_five_iterations(env):
    arm = env.arm
    _, state = jax.jit(env.reset)(jax.random.key(0))
    transition = jax.jit(env.transition)
    for action in (arm.close_action, arm.open_action):
        for _ in range(5):
            state, _ = transition(state, action)
        fingers = state.physics.qpos[arm.finger_qpos]
        target = state.ctrl[arm.gripper_ctrl]
        np.testing.assert_allclose(fingers, target, atol=0.001)


def test_an_arm_of_a_slide_and_a_hinge_has_six_actions(tmp_path):
    arm = crane(tmp_path)
    assert (arm.num_joints, arm.num_actions) == (2, 6)
    # The gripper's servo is between the two of the joints.
    assert arm.ctrl.tolist() == [0, 2]
    assert arm.slides.tolist() == [True, False]
    home = arm.home_ctrl
    changes = [act(arm, home, action) - home for action in range(4)]
    degree = np.deg2rad(1.0)
    expected = [[-0.005, 0, 0], [0.005, 0, 0], [0, 0, -degree], [0, 0, degree]]
    np.testing.assert_allclose(changes, expected, atol=1e-6)
    assert act(arm, home, arm.open_action)[1] == np.float32(0.05)
    assert act(arm, home, arm.close_action)[1] == 0.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ([('joint="boom" kp="100" inheritrange="1"', 'joint="boom" kp="100"')], "no range"),
        ([('<position name="boom" joint="boom" kp="100"', '<motor name="boom" joint="boom"'),
          ('inheritrange="1"/>\n  </act', 'ctrlrange="-1 1"/>\n  </act')], "not a position servo"),
        ([('name="gripper"', 'name="hand"')], "one actuator named 'gripper'"),
        ([('joint="boom" kp', 'gear="2" joint="boom" kp')], "supported is a gear of 1"),
        ([('joint="boom"', 'joint="rail"')], "several servos for one joint"),
        ([('type="hinge" axis="0 1 0" range="-90 90"', 'type="ball"'),
          ('joint="boom" kp="100" inheritrange="1"', 'joint="boom" kp="100" ctrlrange="-1 1"')],
         "joint 'boom' must be a hinge or a slide"),
        ([('name="right_finger"', 'name="finger"')], "no joint named 'right_finger'"),
        ([('<site name="grasp"/>', "")], "no site named 'grasp'"),
        ([('<key name="home"/>', '<key name="rest"/>')], "no keyframe named 'home'"),
        ([('<key name="home"/>', '<key name="home" ctrl="0.6 0 0"/>')], "outside of its range"),
        ([('<key name="home"/>', '<key name="home" ctrl="0.1 0 0"/>')], "must have the joint"),
    ],
)  # fmt: skip
def test_an_arm_that_is_not_as_assumed_is_rejected_by_name(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message) as raised:
        crane(tmp_path, *changes)
    assert "\n" not in str(raised.value)


def test_the_shipped_scene_says_what_the_features_begin_with(env):
    obs, state = jax.jit(env.reset)(jax.random.key(0))
    np.testing.assert_array_equal(obs[:6], state.physics.qpos[env.arm.qpos])
    assert len(env.feature_scales) == len(obs)


def test_no_command_leaves_the_range_of_its_joint(tmp_path):
    wider = '<position name="rail" joint="rail" kp="100" ctrlrange="-2 0.25"/>'
    narrow = '<position name="rail" joint="rail" kp="100" inheritrange="1"/>'
    arm = crane(tmp_path, (narrow, wider))
    assert arm.ctrl_range[0].tolist() == [-0.5, 0.25]
