"""The session behind the viewer: who acts, and what hands do."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_arm
from mjx_arm.view.session import Session, action_names, make_simulation

# A network whose Q-values are its parameters, whatever it sees.
Q = np.zeros(14, np.float32)
Q[3] = 1.0


@pytest.fixture(scope="module")
def simulation():
    env = mjx_arm.make(
        "B", physics="native", observation="packed", size=(16, 16), camera=("front", "front")
    )
    return make_simulation(env, lambda params, obs: params[None])


@pytest.fixture
def session(simulation):
    return Session(simulation, jnp.asarray(Q), seed=3)


def test_a_seed_gives_an_episode(session):
    place = session.position("cube")
    session.step()
    session.restart(4)
    assert np.abs(session.position("cube") - place).max() > 1e-3
    session.restart(3)
    assert (session.position("cube") == place).all()
    assert (session.step_count, session.outcome) == (0, None)


def test_the_agent_takes_the_largest_q_value(session):
    before = np.array(session.state.ctrl)
    session.step()
    assert session.outcome.action == 3
    moved = np.asarray(session.state.ctrl) - before
    # Action 3 turns the second joint by plus one degree.
    assert moved[1] == pytest.approx(np.deg2rad(1), rel=1e-3)
    assert np.count_nonzero(moved) == 1
    assert set(session.outcome.terms) == {"reach", "grasp", "lift", "success"}


def test_other_parameters_act_otherwise(session):
    session.set_params(jnp.asarray(Q[::-1].copy()))
    session.step()
    assert session.outcome.action == 10
    assert session.step_count == 1


def test_random_actions_come_from_the_seed(session):
    session.actor = "random"
    first = [session.choose() for _ in range(20)]
    session.restart(3)
    assert [session.choose() for _ in range(20)] == first
    assert len(set(first)) > 5


def test_epsilon_is_the_share_of_random_actions(session):
    session.epsilon = 0.5
    actions = [session.choose() for _ in range(400)]
    assert 0.4 < np.mean([action != 3 for action in actions]) < 0.55


def test_nobody_keeps_the_arm_where_it_is(session):
    session.actor = "nobody"
    for hand in (12, 13):
        session.step(hand)
        ctrl = np.array(session.state.ctrl)
        session.step()
        assert session.outcome.action == hand
        assert (np.asarray(session.state.ctrl) == ctrl).all()


def test_a_push_moves_the_cube_and_nothing_else(session):
    before = np.array(session.state.physics.qpos)
    image = np.array(session.seen.image)
    session.push("cube", (0.0, 0.04, 0.0))
    moved = np.asarray(session.state.physics.qpos) - before
    address = np.flatnonzero(np.abs(moved) > 1e-6)
    assert len(address) == 1
    assert moved[address[0]] == pytest.approx(0.04, abs=1e-6)
    assert (session.seen.image != image).any()
    assert session.objects == ["cube"]


def test_cameras_are_side_by_side(session):
    assert session.seen.image.shape == (16, 32, 3)
    assert (session.seen.image[:, :16] == session.seen.image[:, 16:]).all()


def test_a_delayed_image_is_shown_as_the_agent_sees_it():
    env = mjx_arm.make("A", physics="native", observation="rgb", size=(32, 32), image_delay=3)
    session = Session(make_simulation(env), None, seed=3)
    state = session.state
    assert int(state.params["image_delay"][0]) > 0, "another seed, for an episode with a delay"
    for _ in range(8):
        state = session.simulation.advance(state, jnp.int32(3))[0]
    seen = session.simulation.look(None, state).image
    np.testing.assert_array_equal(seen, jax.jit(env.observe)(state))
    now = env.render(state.physics.qpos, state.physics.poses, state.params)[0]
    assert (seen != mjx_arm.rgb(now)).any()


def test_actions_have_names(simulation):
    names = action_names(simulation.env)
    assert len(names) == len(set(names)) == 14
    assert names[-2:] == ["open", "close"]
    assert names[0].endswith(" −")
