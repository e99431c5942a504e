from __future__ import annotations

import itertools
import pathlib

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from rollouts import make_pushing_policy, make_random_policy, rollout

import mjx_arm
from mjx_arm.envs.arm import resolve_arm
from mjx_arm.envs.scripted import make_scripted_policy
from mjx_arm.envs.state import Snapshot
from mjx_arm.envs.tasks.lift import (
    Lift,
    LiftConfig,
    completion_reward,
    grasped,
    paper_terms,
    shaped_reward,
)
from mjx_arm.kinematics import make_kinematics

GAMMA = 0.99
LIFT = 0.3
# A force that counts as a touch, N; the cube weighs 0.8 N.
TOUCH_FORCE = 0.1
LEAST_PRECISION = 0.98
LEAST_RECALL = 0.98
REWARDS = {
    "paper": lambda config, _, after, action: paper_terms(config, after, after.measured["height"]),
    "completion": completion_reward,
    "shaped": shaped_reward,
}
SCENE = pathlib.Path(__file__).parents[3] / "xml" / "arm_cube.xml"


def snapshot(*, distance=0.1, height=0.0, grasped=False, success=False) -> Snapshot:
    measured = {
        "distance": jnp.float32(distance),
        "height": jnp.float32(height),
        "grasped": jnp.asarray(grasped),
        "success": jnp.asarray(success),
    }
    return Snapshot(None, measured)


def total(kind: str, config: LiftConfig | None = None, **situation) -> float:
    after = snapshot(**situation)
    config = LiftConfig() if config is None else config
    terms = REWARDS[kind](config, snapshot(), after, jnp.int32(0))
    assert set(terms) == {"reach", "grasp", "lift", "success"}
    assert all((term.shape, term.dtype) == ((), jnp.float32) for term in terms.values())
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
    assert total("paper", **situation) == pytest.approx(expected, rel=1e-6)


def test_the_papers_height_is_that_of_the_cubes_centre():
    """Of a cube that is larger in the episode, too."""
    env = mjx_arm.make(
        "A",
        physics="native",
        observation="state",
        start="in_grasp",
        reward="paper",
        randomisation="standard",
        cube_size=(1.1, 1.2),
    )
    _, state = jax.jit(env.reset)(jax.random.key(0))
    half = float(state.params["geom_size"][env.varies["geom_size"].index(env.task.cube_geom), 0])
    assert 1.1 <= half / env.task.half_size <= 1.2
    after, transition = jax.jit(env.transition)(state, 0)
    height = float(after.physics.poses.geom_xpos[env.task.cube_geom, 2])
    assert float(transition.metrics["height"]) == pytest.approx(height - half, abs=1e-6)
    assert float(transition.reward) == pytest.approx(
        env.config.reward_scale * (1 + height), rel=1e-5
    )


def test_units_of_the_paper_are_options():
    config = LiftConfig(distance_unit=1.0, height_unit=0.01, distance_decay=0.5)
    assert total("paper", config, distance=2.0) == pytest.approx(np.exp(-1.0))
    assert total("paper", config, grasped=True, height=0.2) == pytest.approx(21.0)


@pytest.mark.parametrize(("kind", "hovering_wins"), [("paper", True), ("completion", False)])
def test_only_the_papers_reward_prefers_to_hover(kind, hovering_wins):
    hovering = total(kind, grasped=True, height=0.2999) / (1 - GAMMA)
    success = total(kind, grasped=True, height=LIFT, success=True)
    assert (hovering > success) == hovering_wins


def test_shaping_changes_the_return_of_an_episode_by_the_potential_of_its_start():
    """So the best policy stays the same."""
    config = LiftConfig(shaping_discount=GAMMA)
    way = [
        snapshot(distance=0.3),
        snapshot(distance=0.1),
        # It is grasped, lost and grasped again.
        snapshot(distance=0.0, grasped=True, height=0.1),
        snapshot(distance=0.05, height=0.1),
        snapshot(distance=0.0, grasped=True, height=0.2),
        snapshot(distance=0.0, grasped=True, height=0.3, success=True),
    ]

    def total_of(kind: str, before: Snapshot, after: Snapshot) -> float:
        return float(sum(REWARDS[kind](config, before, after, jnp.int32(0)).values()))

    returns = {
        kind: sum(
            GAMMA**t * total_of(kind, *pair) for t, pair in enumerate(itertools.pairwise(way))
        )
        for kind in ("completion", "shaped")
    }
    start = total_of("completion", way[0], way[0]) / (1 - GAMMA)
    assert returns["shaped"] == pytest.approx(returns["completion"] - start, rel=1e-5)
    # To stay pays nothing, to come nearer pays at once, and to lose the cube costs as much.
    gains = [total_of("shaped", *pair) for pair in itertools.pairwise([way[0], *way])]
    assert gains[0] == 0
    assert [gain > 0 for gain in gains[1:]] == [True, True, False, True, True]


def test_completion_grows_on_the_way():
    way = [
        total("completion", distance=0.3),
        total("completion", distance=0.1),
        total("completion", distance=0.0),
        total("completion", distance=0.0, grasped=True),
        total("completion", distance=0.0, grasped=True, height=0.15),
        total("completion", distance=0.0, grasped=True, height=0.29),
    ]
    assert way == sorted(way)
    assert len(set(way)) == len(way)
    assert way[-1] <= 0.8


@pytest.mark.parametrize("start", ["home", "in_grasp"])
def test_scale_scales_every_term(start):
    options = {"physics": "native", "observation": "state", "reward": "completion", "start": start}
    plain = mjx_arm.make("A", **options)
    scaled = mjx_arm.make("A", reward_scale=0.2, **options)
    _, state = jax.jit(plain.reset)(jax.random.key(0))
    one, other = (jax.jit(env.transition)(state, 3)[1] for env in (plain, scaled))
    assert other.reward == pytest.approx(0.2 * one.reward)
    terms = [name for name in one.info if name.startswith("reward_")]
    assert len(terms) == 4
    for name in terms:
        assert other.info[name] == pytest.approx(0.2 * one.info[name])
    assert one.reward == pytest.approx(sum(one.info[name] for name in terms))
    assert one.reward > 0


@pytest.mark.parametrize("name", ["distance_unit", "height_unit", "distance_decay", "lift"])
def test_constants_out_of_their_domain_are_rejected(name):
    with pytest.raises(ValueError, match=f"{name} must be a finite number above 0, got 0.0"):
        LiftConfig(**{name: 0.0})


@pytest.fixture(scope="module")
def env():
    return mjx_arm.make("B", physics="native", observation="state", placement="always")


def finger_forces(env, states) -> np.ndarray:
    """Sums of the contact forces of each finger on the cube, by MuJoCo C: `[L * N, 2]`, N."""
    model, pads = env.scene.mj_model, [set(row) for row in env.task.pad_geoms]
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
                if env.task.cube_geom in geoms and geoms & pads[finger]:
                    mujoco.mj_contactForce(model, data, index, force)
                    totals[row, finger] += force[0]
    return totals


def test_grasped_agrees_with_the_contact_forces(env):
    scripted = make_scripted_policy(env)
    held = mjx_arm.make("B", physics="native", observation="state", start="in_grasp")
    cases = {
        "scripted": (env, lambda key, state: scripted(state)),
        "random": (held, make_random_policy(held.arm)),
        "pushing": (env, make_pushing_policy(env.arm, scripted)),
    }
    predicted, actual = [], []
    for used, policy in cases.values():
        states, transitions = rollout(used, policy, num_envs=32, length=250, seed=5)
        predicted.append(transitions.metrics["grasped"].reshape(-1))
        actual.append((finger_forces(used, states) > TOUCH_FORCE).all(axis=1))
        assert actual[-1].sum() > 200
    predicted, actual = np.concatenate(predicted), np.concatenate(actual)
    both = (predicted & actual).sum()
    assert both / predicted.sum() >= LEAST_PRECISION
    assert both / actual.sum() >= LEAST_RECALL


def test_a_closed_gripper_on_top_of_the_cube_has_not_grasped_it(env):
    model, arm, task = env.scene.mj_model, env.arm, env.task
    qpos = arm.home_qpos.copy()
    qpos[arm.finger_qpos] = arm.ctrl_range[arm.gripper_ctrl, 0]
    _, state = jax.jit(env.reset)(jax.random.key(0))
    poses = make_kinematics(model)(jnp.asarray(qpos))
    lowest = (
        float(np.min(poses.geom_xpos[task.pad_geoms, 2])) - model.geom_size[task.pad_geoms[0, 0], 0]
    )
    cube = poses.geom_xpos.at[task.cube_geom].set(
        poses.site_xpos[arm.grasp_site].at[2].set(lowest - task.half_size + 1e-4)
    )
    poses = poses.replace(geom_xpos=cube)
    closed = state.ctrl.at[arm.gripper_ctrl].set(arm.ctrl_range[arm.gripper_ctrl, 0])
    assert not grasped(task, poses, closed)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("cube_rectangle", "cube_place", "no numeric named 'cube_rectangle'"),
        ('name="left_pad_0"', 'name="left_pad"', "geom|left_pad"),
    ],
)
def test_a_scene_without_what_the_task_needs_is_rejected_by_name(tmp_path, old, new, message):
    text = SCENE.read_text()
    assert old in text
    path = tmp_path / "scene.xml"
    path.write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=message):
        mjx_arm.make("A", scene=str(path))


LEFT_PAD = '<geom name="left_pad_0" class="pad" pos="0.112 0.008 0.007"/>'
GRASP = '<site name="grasp" pos="0.1072 0 0" size="0.004" group="3"/>'
FREE, ON_A_SLIDE = '<freejoint name="cube"/>', '<joint name="cube" type="slide" axis="1 0 0"/>'
PLACE = " 0.36 0 0.025 1 0 0 0"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {'<joint name="left_finger"': '<joint name="left_finger" type="hinge"'},
            "joint 'left_finger' must be a slide",
        ),
        (
            {'"right_finger" axis="0 -1 0"': '"right_finger" axis="0 -1 1"'},
            "joint 'right_finger' must slide along x, y or z of its body",
        ),
        (
            {LEFT_PAD: "", GRASP: GRASP + LEFT_PAD},
            "'left_pad_0' must be on the body of joint 'left",
        ),
        (
            {LEFT_PAD: LEFT_PAD.replace("/>", ' euler="0 0 30"/>')},
            "geom 'left_pad_0' must have no rotation of its own",
        ),
        (
            {LEFT_PAD: LEFT_PAD.replace("0.008", "0.012")},
            "'left_pad_0' must be as far from the site 'grasp' as .* 0.0580 m .*, got 0.0620 m",
        ),
        (
            {'<joint name="left_finger" axis="0 1 0"': '<joint name="left_finger" axis="0 -1 0"'},
            "'left_pad_0' must be as far from the site 'grasp' as joint 'left_finger' says",
        ),
        ({FREE: ON_A_SLIDE, PLACE: " 0"}, "joint 'cube' must be a free joint"),
        (
            {PLACE: " 0.36 0 0.025 0.9659 0.2588 0 0"},
            r"the cube must be level, turned about the vertical only, got .*0\.2588",
        ),
        (
            {'name="table" type="plane"': 'name="table" type="plane" pos="0 0 -0.1"'},
            r"nothing holds the cube, which falls by 0\.0\d+ m in 0\.1 s",
        ),
    ],
)
def test_fingers_and_joints_that_the_task_cannot_use_are_rejected_by_name(
    tmp_path, changes, message
):
    text = SCENE.read_text()
    for old, new in changes.items():
        assert text.count(old) == 1
        text = text.replace(old, new)
    path = tmp_path / "scene.xml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as raised:
        mjx_arm.make("A", scene=str(path))
    assert "\n" not in str(raised.value)


def test_a_second_free_body_before_the_cube_stays_where_the_keyframe_has_it(tmp_path):
    """The scene's first body, so that its joint comes first in every array."""
    ball = '<body name="ball" pos="0 0.5 0.02"><freejoint/><geom size="0.02" mass="0.1"/></body>'
    text = SCENE.read_text().replace('<body name="base">', ball + '<body name="base">')
    path = tmp_path / "scene.xml"
    path.write_text(text.replace('qpos="0 0.0402', 'qpos="0 0.5 0.02 1 0 0 0 0 0.0402'))
    scene, plain = mjx_arm.load_scene(path), mjx_arm.load_scene("arm_cube")
    arm, place = resolve_arm(scene), jnp.asarray([0.33, -0.07], jnp.float32)
    task = Lift(LiftConfig(), scene, arm)
    qpos, _, _ = task.start(jnp.asarray(arm.home_qpos), jnp.asarray(arm.home_ctrl), place)
    np.testing.assert_allclose(qpos[:7], [0, 0.5, 0.02, 1, 0, 0, 0], atol=1e-6)
    np.testing.assert_array_equal(qpos[arm.qpos], resolve_arm(plain).home_qpos[:6])
    data = mujoco.MjData(scene.mj_model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(scene.mj_model, data)
    cube = data.geom_xpos[task.cube_geom]
    np.testing.assert_allclose(cube, [*place, task.half_size], atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"type": mujoco.mjtGeom.mjGEOM_SPHERE}, "a box of three equal edges"),
        ({"size": [0.03, 0.02, 0.02]}, "a box of three equal edges"),
        ({"pos": [0.0, 0.0, 0.01]}, "at the origin of its body"),
        ({"size": [0.001] * 3}, "on the ground at height 0"),
    ],
)
def test_another_body_than_a_cube_is_rejected_by_name(tmp_path, change, message):
    spec = mujoco.MjSpec.from_file(str(SCENE))
    cube = spec.geom("cube")
    for name, value in change.items():
        setattr(cube, name, value)
    spec.compile()
    path = tmp_path / "scene.xml"
    path.write_text(spec.to_xml())
    with pytest.raises(ValueError, match=message) as raised:
        mjx_arm.make("A", scene=str(path))
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("name", ["A", "B"])
def test_a_share_of_the_starts_has_the_cube_in_the_gripper(name):
    envs = {
        share: mjx_arm.make(name, physics="native", observation="state", in_grasp_share=share)
        for share in (0.0, 0.25)
    }
    keys = jax.random.split(jax.random.key(3), 400)

    def starts(share: float):
        env = envs[share]
        state = jax.jit(jax.vmap(env.reset))(keys)[1]
        return state, jax.vmap(env.task.measure)(state)

    plain, measured = starts(0.0)
    assert not measured["grasped"].any()
    state, measured = starts(0.25)
    eased = np.asarray(measured["grasped"])
    assert 70 < eased.sum() < 130
    # The others are the starts that they were, and the arm is where it was in all of them.
    for field in ("qpos", "ctrl"):
        before, after = (
            np.asarray(getattr(x, field) if field == "ctrl" else x.physics.qpos)
            for x in (plain, state)
        )
        np.testing.assert_allclose(after[~eased], before[~eased], atol=1e-6)
    joints = envs[0.0].arm.qpos
    before, after = plain.physics.qpos[:, joints], state.physics.qpos[:, joints]
    np.testing.assert_allclose(after, before, atol=1e-6)
    assert np.all(np.asarray(measured["distance"])[eased] < 1e-3)


def test_the_next_episode_is_eased_by_its_own_key():
    env = mjx_arm.make("A", physics="native", observation="state", in_grasp_share=0.5)
    _, state = jax.jit(env.reset)(jax.random.key(0))
    again = jax.jit(jax.vmap(env.restart, (0, None)))(
        jax.random.split(jax.random.key(1), 64), state
    )
    assert 16 < jax.vmap(env.task.measure)(again)["grasped"].sum() < 48


def test_a_share_of_starts_that_are_all_in_the_grasp_is_rejected():
    with pytest.raises(ValueError, match="in_grasp_share must be 0 with start 'in_grasp', got 0"):
        LiftConfig(start="in_grasp", in_grasp_share=0.3)


@pytest.mark.parametrize("share", [-0.1, 1.5, "half"])
def test_a_share_that_is_none_is_rejected(share):
    with pytest.raises(ValueError, match="in_grasp_share must be a finite number from 0 to 1"):
        mjx_arm.make("A", in_grasp_share=share)
