"""The arm cannot be commanded into itself, its base or the table, nor the cube pressed into a link.

The first is looked at in the environment, with distances by MuJoCo C. The second is a matter of the
scene's contacts alone, so MuJoCo C steps it.
"""

from __future__ import annotations

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjx_arm
from mjx_arm.envs.arm import apply_action
from mjx_arm.envs.collision import MARGIN
from mjx_arm.scene import load_scene

NUM_ENVS = 64
# Steps of one action, and how many actions follow one another in an episode.
REPEATS, ACTIONS = 70, 5
# What a blocked command may at most be away from, m: the clearance that it was blocked by is too
# small by up to 8 mm (tests/envs/test_collision.py).
MOST_BLOCKED = MARGIN + 0.008
FAR = 0.1


@dataclasses.dataclass(frozen=True)
class Driven:
    """Rollouts in which each joint runs on until it must stop.

    Attributes:
      env: the environment.
      actions: `[L, N] int32`.
      qpos: `[L, N, nq]`, after each action.
      before: `[L, N, nq]`, before each action.
      ctrl: `[L, N, nu]`, after each action.
      ctrl_before: `[L, N, nu]`, before each action.
      wanted: `[L, N, nu]`, what the action asked for.
      blocked: `[L, N] bool`.
    """

    env: mjx_arm.Env
    actions: np.ndarray
    qpos: np.ndarray
    before: np.ndarray
    ctrl: np.ndarray
    ctrl_before: np.ndarray
    wanted: np.ndarray
    blocked: np.ndarray


@pytest.fixture(scope="module")
def driven() -> Driven:
    env = mjx_arm.make("A", physics="native", observation="state")
    random = np.random.default_rng(0)
    chosen = random.integers(0, 2 * env.arm.num_joints, (ACTIONS, NUM_ENVS))
    actions = chosen.repeat(REPEATS, axis=0).astype(np.int32)

    def step(state, action):
        after, transition = env.transition(state, action)
        wanted = apply_action(env.arm, state.ctrl, action, 1.0, 5.0)
        pair = (state.physics.qpos, after.physics.qpos, state.ctrl, after.ctrl)
        return after, (*pair, wanted, transition.info["blocked"])

    def run(key, actions):
        return jax.lax.scan(step, env.reset(key)[1], actions)[1]

    keys = jax.random.split(jax.random.key(0), NUM_ENVS)
    found = jax.jit(jax.vmap(run, in_axes=(0, 1), out_axes=1))(keys, jnp.asarray(actions))
    before, qpos, ctrl_before, ctrl, wanted, blocked = (np.asarray(x) for x in found)
    return Driven(env, actions, qpos, before, ctrl, ctrl_before, wanted, blocked)


def distances(env: mjx_arm.Env, qpos: np.ndarray) -> np.ndarray:
    """Of the pairs of the arm, at most `FAR`, by MuJoCo C: `[S, P]`, m."""
    model, rows, points = env.scene.mj_model, [], np.zeros(6)
    data = mujoco.MjData(model)
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        pairs = env.collision.pairs.tolist()
        rows.append([mujoco.mj_geomDistance(model, data, a, b, FAR, points) for a, b in pairs])
    return np.asarray(rows)


def commanded(driven: Driven, ctrl: np.ndarray, rows: tuple[np.ndarray, ...]) -> np.ndarray:
    """`[S, nq]` with the arm's joints where commands would have them."""
    qpos = driven.before[rows].copy()
    qpos[:, driven.env.arm.qpos] = ctrl[rows][:, driven.env.arm.ctrl]
    return qpos


def some(rows: np.ndarray, count: int = 400) -> tuple[np.ndarray, ...]:
    """Some of the indices at which `[L, N] bool` is true."""
    steps, envs = np.nonzero(rows)
    chosen = np.random.default_rng(1).permutation(len(steps))[:count]
    return steps[chosen], envs[chosen]


def test_a_blocked_command_is_not_given_and_every_other_one_is(driven):
    assert 500 < driven.blocked.sum() < 0.6 * driven.blocked.size
    given = np.where(driven.blocked[..., None], driven.ctrl_before, driven.wanted)
    np.testing.assert_array_equal(driven.ctrl, given)
    # A command that is blocked asks for something: it is not at the end of its range.
    asked = np.abs(driven.wanted - driven.ctrl_before).max(axis=-1)
    assert (asked[driven.blocked] > 1e-3).all()


def test_the_arm_never_touches_the_table_its_base_or_itself(driven):
    everywhere = some(np.ones_like(driven.blocked))
    after_a_block = some(driven.blocked)
    for rows in (everywhere, after_a_block):
        assert distances(driven.env, driven.qpos[rows]).min() >= 0


def test_what_is_blocked_is_near_and_is_the_table_the_base_and_the_arm(driven):
    env, model = driven.env, driven.env.scene.mj_model
    found = distances(env, commanded(driven, driven.wanted, some(driven.blocked)))
    nearest = found.argmin(axis=1)
    assert found.min(axis=1).max() < MOST_BLOCKED
    other, _ = env.collision.pairs[nearest].T
    still = model.body_weldid[model.geom_bodyid[other]] == 0
    plane = model.geom_type[other] == mujoco.mjtGeom.mjGEOM_PLANE
    kinds = {"table": plane, "base": still & ~plane, "itself": ~still}
    assert {name for name, rows in kinds.items() if rows.any()} == set(kinds), kinds


def test_what_is_not_blocked_leads_nowhere_in(driven):
    rows = some(~driven.blocked)
    assert distances(driven.env, commanded(driven, driven.ctrl, rows)).min() >= 0


# Four times the cube's weight, N.
FORCE = 3.0
GAP = 0.002
# The cube meets most links by a sphere that its edges and corners stick out of, by 7 and 15 mm.
MOST_DEPTH = 0.022
PRESSED_STEPS = 60


def links(model: mujoco.MjModel) -> list[int]:
    """What is seen of the arm and its base."""
    root = model.body_rootid[model.jnt_bodyid[model.actuator_trnid[0, 0]]]
    return np.flatnonzero(
        (model.geom_group < 3) & (model.body_rootid[model.geom_bodyid] == root)
    ).tolist()


def put_cube(model, data, link: int, direction: np.ndarray) -> bool:
    """Puts the cube before a link; false where something else is in the way."""
    place = model.jnt_qposadr[model.joint("cube").id]
    cube, points = model.geom("cube").id, np.zeros(6)
    others = [g for g in links(model) if g != link] + [model.geom("table").id]

    def distance(other: int) -> float:
        return mujoco.mj_geomDistance(model, data, cube, other, 1.0, points)

    away = 0.6
    for _ in range(60):
        data.qpos[place : place + 3] = data.geom_xpos[link] + away * direction
        mujoco.mj_kinematics(model, data)
        step = distance(link) - GAP
        away -= step
        if abs(step) < 1e-5:
            break
    return min(distance(other) for other in others) > 0


def press(model, link: int, direction: np.ndarray) -> float | None:
    """How deep the cube gets into a link when it is pushed from a direction, m; None: no way."""
    data, points = mujoco.MjData(model), np.zeros(6)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    mujoco.mj_kinematics(model, data)
    rotation = data.geom_xmat[link].reshape(3, 3)
    direction = rotation @ direction
    if not put_cube(model, data, link, direction):
        return None
    cube, body = model.geom("cube").id, model.body("cube").id
    weight = model.body_mass[body] * model.opt.gravity
    deepest = 0.0
    for _ in range(PRESSED_STEPS):
        data.xfrc_applied[body, :3] = -FORCE * direction - weight
        mujoco.mj_step(model, data)
        found = mujoco.mj_geomDistance(model, data, cube, link, 1.0, points)
        deepest = max(deepest, -found)
    return deepest


@pytest.mark.parametrize("scene", ["arm_cube", "arm_cube_desk", "arm_push", "panda_cube"])
def test_the_cube_cannot_be_pressed_into_a_link(scene):
    model = load_scene(scene).mj_model
    directions = [np.asarray(d, float) for d in itertools.product((-1, 0, 1), repeat=3) if any(d)]
    depths = {}
    for link in links(model):
        found = [press(model, link, way / np.linalg.norm(way)) for way in directions]
        depths[model.geom(link).name] = [x for x in found if x is not None]
    print({name: [round(1000 * x, 1) for x in found] for name, found in depths.items()})
    assert all(depths.values()), "a link that nothing can be pressed against"
    deep = {name: max(found) for name, found in depths.items() if max(found) > MOST_DEPTH}
    assert not deep
