"""The robots that are shipped, and what `resolve_arm` makes of others."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjx_arm
from mjx_arm.envs.arm import (
    Arm,
    apply_action,
    arm_feature_scales,
    arm_features,
    resolve_arm,
)
from mjx_arm.envs.collision import Collision
from mjx_arm.envs.scripted import _make_tool, make_scripted_policy
from mjx_arm.envs.tasks.lift import Lift, LiftConfig
from mjx_arm.kinematics import make_kinematics
from mjx_arm.physics import Physics, PhysicsState, make_physics
from mjx_arm.scene import Scene, load_scene

ROBOTS = {"arm_cube": 6, "panda_cube": 7}
# Of a joint after two iterations, and of the joints that were not moved, degrees.
MOST_ERROR = 0.15
MOST_SAG = 0.3
MOST_SLIPPING = 0.005
HOLD_SECONDS = 20.0
# A force that counts as a touch, N; the cube weighs 0.8 N.
TOUCH_FORCE = 0.1
LEAST_AGREEMENT = 0.98
LEAST_SUCCESS = 0.96


@dataclasses.dataclass(frozen=True)
class Robot:
    """A scene with its physics, compiled for one environment for each direction of each joint."""

    scene: Scene
    arm: Arm
    physics: Physics
    init: Callable[[np.ndarray, np.ndarray], PhysicsState]
    run: Callable[[PhysicsState, jax.Array, int], PhysicsState]

    def home(self) -> tuple[PhysicsState, jax.Array]:
        """A state at home for each action but those of the gripper, and its commands."""
        count = 2 * self.arm.num_joints
        ctrl = jnp.tile(self.arm.home_ctrl, (count, 1))
        return self.init(jnp.tile(self.arm.home_qpos, (count, 1)), ctrl), ctrl

    def degrees(self, state: PhysicsState) -> np.ndarray:
        """`[N, n]`."""
        return np.rad2deg(np.asarray(state.qpos[:, self.arm.qpos]))


@pytest.fixture(scope="module", params=ROBOTS)
def robot(request) -> Robot:
    scene = load_scene(request.param)
    physics = make_physics(scene.mj_model, "native", substeps=scene.substeps)

    @jax.jit
    def run(state: PhysicsState, ctrl: jax.Array, iterations: int) -> PhysicsState:
        return jax.lax.fori_loop(
            0, iterations, lambda _, state: jax.vmap(physics.step)(state, ctrl), state
        )

    return Robot(scene, resolve_arm(scene), physics, jax.jit(jax.vmap(physics.init)), run)


def test_there_are_two_actions_a_joint_and_two_of_the_gripper(robot):
    assert robot.arm.num_joints == ROBOTS[robot.scene.name]
    assert robot.arm.num_actions == 2 * ROBOTS[robot.scene.name] + 2


def test_home_is_a_fixed_point(robot):
    state, ctrl = robot.home()
    after = robot.run(state, ctrl, 100)
    assert np.abs(robot.degrees(after) - robot.degrees(state)).max() < MOST_SAG
    assert np.abs(np.asarray(after.qvel)).max() < 1e-3
    np.testing.assert_allclose(after.qpos[:, -7:], state.qpos[:, -7:], atol=1e-3)


def test_each_action_moves_its_joint_by_one_degree_within_two_iterations(robot):
    state, ctrl = robot.home()
    state = robot.run(state, ctrl, 60)
    actions = jnp.arange(2 * robot.arm.num_joints)
    ctrl = jax.vmap(lambda c, a: apply_action(robot.arm, c, a, 1.0, 5.0))(ctrl, actions)
    moved = robot.degrees(robot.run(state, ctrl, 2)) - robot.degrees(state)
    expected = np.kron(np.eye(robot.arm.num_joints), [[-1.0], [1.0]])
    print(f"{robot.scene.name}: worst error {np.abs(moved - expected).max():.3f} degrees")
    np.testing.assert_allclose(moved, expected, atol=MOST_ERROR)


def test_the_gripper_closes_and_opens_in_five_iterations(robot):
    state, ctrl = robot.home()
    for action in (robot.arm.close_action, robot.arm.open_action):
        ctrl = jax.vmap(lambda c, a=action: apply_action(robot.arm, c, jnp.int32(a), 1.0, 5.0))(
            ctrl
        )
        state = robot.run(state, ctrl, 5)
        target = ctrl[:, [robot.arm.gripper_ctrl]] * jnp.ones(2)
        np.testing.assert_allclose(state.qpos[:, robot.arm.finger_qpos], target, atol=1e-3)


def test_a_held_cube_stays_held(robot):
    task = Lift(LiftConfig(start="in_grasp"), robot.scene, robot.arm)
    state, ctrl = robot.home()
    place = task.fixed_placement()
    qpos, ctrl, _ = jax.vmap(lambda q, c: task.start(q, c, place))(state.qpos, ctrl)
    before = robot.run(robot.init(qpos, ctrl), ctrl, 25)
    iteration = robot.physics.substeps * robot.physics.timestep
    after = robot.run(before, ctrl, round(HOLD_SECONDS / iteration))
    assert not np.asarray(after.diverged).any()
    height = np.asarray(after.qpos[:, task.cube_qpos + 2])
    assert height.min() > task.half_size + 0.1
    slip = np.asarray(after.qpos - before.qpos)[:, task.cube_qpos : task.cube_qpos + 3]
    assert np.linalg.norm(slip, axis=1).max() < MOST_SLIPPING


def scripted_rollout(scene: str, num_envs: int, length: int, *, collision: bool):
    """The environment, `[length, N]` states, and transitions of the scripted policy in B.

    Without `collision` the environment does not check the arm for collisions with itself and the
    ground: to compile that check takes four times as long as the rest.
    """
    env = mjx_arm.make("B", scene=scene, physics="native", observation="state", placement="always")
    if not collision:

        def apart(poses):
            return jnp.full((1,), jnp.inf)

        none = np.zeros(0, int)
        free = Collision(none.reshape(0, 2), 0.0, apart, none, apart)
        links = make_kinematics(env.scene.mj_model, geoms=())
        starts = dataclasses.replace(env.starts, collision=free)
        env = dataclasses.replace(env, collision=free, link_kinematics=links, starts=starts)
    policy = make_scripted_policy(env)

    def step(state, _):
        after, transition = env.transition(state, policy(state))
        physics = after.physics
        return after, (physics.qpos, physics.qvel, after.ctrl, transition)

    def run(key):
        return jax.lax.scan(step, env.reset(key)[1], None, length=length)[1]

    keys = jax.random.split(jax.random.key(11), num_envs)
    return env, jax.device_get(jax.jit(jax.vmap(run, out_axes=1))(keys))


def finger_forces(env, qpos, qvel, ctrl) -> np.ndarray:
    """Sums of the contact forces of each finger on the cube, by MuJoCo C: `[L * N, 2]`, N."""
    model, task = env.scene.mj_model, env.task
    data, force = mujoco.MjData(model), np.zeros(6)
    finger = {int(pad): side for side in (0, 1) for pad in task.pad_geoms[side]}
    totals = np.zeros((len(qpos), 2))
    for row in range(len(qpos)):
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[row], qvel[row], ctrl[row]
        mujoco.mj_forward(model, data)
        for index, contact in enumerate(data.contact):
            pads = [int(geom) for geom in contact.geom if int(geom) in finger]
            if pads and task.cube_geom in contact.geom:
                mujoco.mj_contactForce(model, data, index, force)
                totals[row, finger[pads[0]]] += force[0]
    return totals


@pytest.mark.parametrize("scene", ROBOTS)
def test_the_scripted_policy_lifts_the_cube_and_grasped_agrees_with_contact_forces(scene):
    env, (qpos, qvel, ctrl, transition) = scripted_rollout(scene, 16, 350, collision=False)
    assert transition.terminated.any(axis=0).mean() >= 0.85
    grasped = transition.metrics["grasped"].ravel()
    forces = finger_forces(env, *(x.reshape(-1, x.shape[-1]) for x in (qpos, qvel, ctrl)))
    pressed = (forces > TOUCH_FORCE).all(axis=1)
    both = (grasped & pressed).sum()
    assert both > 500
    assert both / grasped.sum() >= LEAST_AGREEMENT
    assert both / pressed.sum() >= LEAST_AGREEMENT


@pytest.mark.slow
@pytest.mark.parametrize("scene", ROBOTS)
def test_the_scripted_policy_succeeds_from_nearly_all_starts(scene):
    _, (*_, transition) = scripted_rollout(scene, 500, 1000, collision=True)
    share = transition.terminated.any(axis=0).mean()
    print(f"{scene}: {share:.3f} of 500 starts")
    assert share >= LEAST_SUCCESS


def mjcf(*joints: str, servos: str = "", home: str = "") -> str:
    """An arm of boxes in a row, one for each joint, with a gripper."""
    links = "".join(
        f'<body pos="0.1 0 0.02"><joint name="j{i}" {joint}/>'
        '<geom type="box" size="0.05 0.01 0.01" mass="1"/>'
        for i, joint in enumerate(joints)
    )
    default = "".join(
        f'<position name="j{i}" joint="j{i}" kp="100" kv="5" inheritrange="1"/>'
        for i in range(len(joints))
    )
    zeros = " ".join(["0"] * len(joints))
    return f"""
<mujoco>
  <worldbody>
    {links}
      <site name="grasp" pos="0.2 0 0"/>
      <body name="left">
        <joint name="left_finger" type="slide" axis="0 1 0" range="0 0.05"/>
        <geom size="0.01" mass="0.1"/>
      </body>
      <body name="right">
        <joint name="right_finger" type="slide" axis="0 -1 0" range="0 0.05"/>
        <geom size="0.01" mass="0.1"/>
      </body>
    {"</body>" * len(joints)}
  </worldbody>
  <actuator>
    {servos or default}
    <position name="gripper" joint="left_finger" kp="100" kv="5" inheritrange="1"/>
  </actuator>
  <keyframe>{home or f'<key name="home" qpos="{zeros} 0.05 0.05" ctrl="{zeros} 0.05"/>'}</keyframe>
</mujoco>
"""


TURN_Y, TURN_Z = (f'axis="{axis}" range="-90 90"' for axis in ("0 1 0", "0 0 1"))
SLIDE = 'type="slide" axis="1 0 0" range="-0.2 0.2"'
OTHERS = {"five": (TURN_Z, TURN_Y, TURN_Y, TURN_Y, TURN_Z), "slide": (TURN_Z, SLIDE, TURN_Y)}


@pytest.fixture
def load(tmp_path):
    def load_text(text: str) -> Scene:
        path = tmp_path / "arm.xml"
        path.write_text(text)
        return load_scene(path)

    return load_text


@pytest.mark.parametrize("name", OTHERS)
def test_an_arm_of_ones_own_gets_its_actions_and_features(name, load):
    joints = OTHERS[name]
    scene = load(mjcf(*joints))
    arm, count = resolve_arm(scene), len(joints)
    assert (arm.num_joints, arm.num_actions) == (count, 2 * count + 2)
    assert arm.slides.tolist() == [joint == SLIDE for joint in joints]
    ctrl = jnp.asarray(arm.home_ctrl)
    for joint in range(count):
        after = apply_action(arm, ctrl, jnp.int32(2 * joint + 1), 2.0, 5.0)
        step = 0.005 if arm.slides[joint] else np.deg2rad(2.0)
        expected = np.eye(count + 1)[joint] * step
        np.testing.assert_allclose(after - ctrl, expected, atol=1e-6)
    poses = make_kinematics(scene.mj_model)(jnp.asarray(arm.home_qpos))
    features = arm_features(arm, arm.home_qpos, ctrl, poses.site_xpos[arm.grasp_site])
    assert features.shape == (count + 5,)
    assert len(arm_feature_scales(arm)) == count + 5
    np.testing.assert_allclose(features[-3:], [0.1 * count + 0.2, 0, 0.02 * count], atol=1e-6)


@pytest.mark.parametrize("name", OTHERS)
def test_the_slopes_of_the_tool_are_its_derivatives(name, load):
    scene = load(mjcf(*OTHERS[name]))
    arm = resolve_arm(scene)
    tool = _make_tool(scene, arm)
    joints = jnp.linspace(-0.15, 0.15, arm.num_joints, dtype=jnp.float32)
    pose, slopes = tool(joints)
    qpos = jnp.asarray(arm.home_qpos).at[arm.qpos].set(joints)
    site = make_kinematics(scene.mj_model)(qpos).site_xpos[arm.grasp_site]
    np.testing.assert_allclose(pose[0], site, atol=1e-6)
    expected = jax.jacfwd(lambda joints: tool(joints)[0])(joints)
    np.testing.assert_allclose(slopes, expected, atol=1e-5)


def servos(kind: str = "position", **attributes: str) -> str:
    text = " ".join(f'{name}="{value}"' for name, value in attributes.items())
    return f'<{kind} name="j0" joint="j0" {text}/>'


def general(**attributes: str) -> str:
    return servos("general", ctrlrange="-1 1", biastype="affine", gainprm="9", **attributes)


@pytest.mark.parametrize(
    "servo",
    [
        servos(kp="9", kv="1", ctrlrange="-1 1"),
        servos(kp="9", ctrlrange="-1 1", timeconst="0.1"),
        general(biasprm="0 -9 -1", dyntype="filter", dynprm="0.1"),
    ],
)
def test_a_position_servo_with_or_without_a_filter_is_taken(servo, load):
    arm = resolve_arm(load(mjcf(TURN_Y, servos=servo)))
    np.testing.assert_allclose(arm.ctrl_range[0], [-1.0, 1.0])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"servos": servos(kp="9")}, "actuator 'j0' has no range of commands"),
        (
            {"servos": '<motor name="j0" joint="j0" ctrlrange="-1 1"/>'},
            "actuator 'j0' is not a position servo",
        ),
        (
            {"servos": '<velocity name="j0" joint="j0" kv="9" ctrlrange="-1 1"/>'},
            "actuator 'j0' is not a position servo",
        ),
        (
            {"servos": servos("intvelocity", kp="9", actrange="-1 1", ctrlrange="-1 1")},
            "actuator 'j0' is not a position servo",
        ),
        (
            {"servos": general(biasprm="1 -9 0")},
            "actuator 'j0' is not a position servo",
        ),
        (
            {"servos": general(biasprm="0 -9 0", dyntype="integrator", actrange="-1 1")},
            "actuator 'j0' is not a position servo",
        ),
        (
            {"servos": servos(kp="9", ctrlrange="-1 1", gear="2")},
            r"actuator 'j0' has the gear \[2.0",
        ),
        (
            {
                "servos": servos(kp="9", inheritrange="1")
                + servos(kp="9", inheritrange="1").replace('name="j0"', 'name="again"')
            },
            "several servos for one joint",
        ),
        (
            {"home": '<key name="home" qpos="2 0 0.05 0.05" ctrl="2 0 0.05"/>'},
            r"actuator 'j0': the keyframe 'home' commands 2.0, outside of its range",
        ),
        (
            {"home": '<key name="home" qpos="0.1 0 0.05 0.05" ctrl="0 0 0.05"/>'},
            "actuator 'j0': the keyframe 'home' must have the joint where its command puts it",
        ),
        ({"home": '<key name="away"/>'}, "no keyframe named 'home'"),
    ],
)
def test_an_invalid_robot_is_rejected_by_name(options, message, load):
    if "servos" in options:
        options = {**options, "home": '<key name="home"/>'}
    with pytest.raises(ValueError, match=message) as raised:
        resolve_arm(load(mjcf(TURN_Y, TURN_Z, **options)))
    assert "\n" not in str(raised.value)
