from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

import mjx_arm
from mjx_arm.envs.env import Env
from mjx_arm.envs.scripted import make_scripted_policy
from mjx_arm.standin.levels import Offsets, find_level
from mjx_arm.standin.world import StandIn

pytestmark = pytest.mark.usefixtures("opengl")


@pytest.fixture(scope="module")
def env() -> Env:
    return mjx_arm.make("A", physics="native", observation="packed")


@pytest.fixture(scope="module")
def reset(env: Env):
    return jax.jit(env.reset)


@pytest.fixture(scope="module")
def transition(env: Env):
    return jax.jit(env.transition)


def at(world: StandIn, state) -> None:
    world.reset(np.asarray(state.physics.qpos), np.asarray(state.ctrl))


def test_without_offsets_it_is_the_simulator(env, reset, transition) -> None:
    """Poses to the last bit, the same measures, over a whole grasp; and nearly the same image."""
    world = StandIn(env, Offsets(), shadows=False)
    _, state = reset(jax.random.key(0))
    at(world, state)
    policy, measure = jax.jit(make_scripted_policy(env)), jax.jit(env.task.measure)
    grasped = blocked = 0
    for step in range(140):
        action = int(policy(state)) if step % 7 else step % env.num_actions
        state, made = transition(state, action)
        image = world.step(action)
        assert np.array_equal(world.data.qpos.astype(np.float32), state.physics.qpos), step
        assert np.array_equal(world.ctrl, state.ctrl), step
        expected, found = measure(state), world.measure()
        assert found.grasped == expected["grasped"]
        assert found.height == pytest.approx(float(expected["height"]), abs=1e-7)
        assert found.distance == pytest.approx(float(expected["distance"]), abs=1e-6)
        grasped, blocked = grasped + found.grasped, blocked + bool(made.info["blocked"])
        if step % 20 == 0:
            own = np.asarray(mjx_arm.rgb(env.observe(state)), float)
            # MuJoCo smooths edges, and rounds bodies by polyhedra.
            assert np.abs(image.astype(float) - own).mean() < 3.0
    assert grasped > 10
    world.close()


def test_a_blocked_command_is_blocked_here_too(env, reset, transition) -> None:
    world = StandIn(env, Offsets())
    _, state = reset(jax.random.key(0))
    at(world, state)
    elbow_down, carried_out = 5, []
    for _ in range(60):
        state, made = transition(state, elbow_down)
        carried_out.append(world.command(elbow_down))
        world.advance()
        assert carried_out[-1] != bool(made.info["blocked"])
    assert not all(carried_out)
    world.close()


def test_the_image_is_late_and_the_step_is_short(env, reset) -> None:
    offsets = dataclasses.replace(Offsets(), image_delay=2, short_step=0.1)
    late, prompt = StandIn(env, offsets), StandIn(env, dataclasses.replace(offsets, image_delay=0))
    _, state = reset(jax.random.key(0))
    at(late, state)
    at(prompt, state)
    first = prompt.image
    taken, seen = [], []
    for _ in range(5):
        taken.append(prompt.step(0))
        seen.append(late.step(0))
    assert np.array_equal(seen[0], first)
    assert np.array_equal(seen[1], first)
    assert all(np.array_equal(x, y) for x, y in zip(seen[2:], taken, strict=False))
    assert not np.array_equal(seen[2], first)
    moved = np.rad2deg(prompt.ctrl - np.asarray(state.ctrl))
    assert moved[0] == pytest.approx(-5 * 0.9, abs=1e-4)
    late.close()
    prompt.close()


def test_a_level_changes_image_and_motion(env, reset) -> None:
    plain, moved = StandIn(env, Offsets()), StandIn(env, find_level("test"))
    _, state = reset(jax.random.key(0))
    at(plain, state)
    at(moved, state)
    assert np.abs(plain.image.astype(int) - moved.image).mean() > 3
    for _ in range(20):
        plain.step(3)
        moved.step(3)
    assert not np.allclose(plain.data.qpos, moved.data.qpos, atol=1e-3)
    plain.close()
    moved.close()


def test_cameras_leave_the_settings_of_a_model_as_they_are(env) -> None:
    world = StandIn(env, Offsets())
    found, own = world.model.vis.quality, env.scene.mj_model.vis.quality
    assert (found.offsamples, found.shadowsize) == (own.offsamples, own.shadowsize)
    world.close()


def test_hold_keeps_the_joints_where_they_are(env, reset) -> None:
    world = StandIn(env, Offsets())
    at(world, reset(jax.random.key(0))[1])
    for _ in range(10):
        world.step(1)
    world.hold()
    before = world.joints
    for _ in range(20):
        world.advance()
    assert world.joints == pytest.approx(before, abs=0.5)
    world.close()


def test_other_tasks_and_observations_are_rejected() -> None:
    with pytest.raises(ValueError, match="the stand-in is for the task 'lift', got 'reach'"):
        StandIn(mjx_arm.make("A", task="reach"), Offsets())
    with pytest.raises(ValueError, match="observes 'state': give an agent that sees pixels"):
        StandIn(mjx_arm.make("A", observation="state"), Offsets())
