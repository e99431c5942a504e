from __future__ import annotations

import jax
import mujoco
import numpy as np
import pytest

import mjx_arm
from mjx_arm.envs.starts import MAX_SAMPLES

STARTS = 10_000
# At most this share of the samples may be rejected, or resets would be slow; 7 % are.
MOST_REJECTED = 0.3


@pytest.fixture(scope="module")
def env():
    return mjx_arm.make("B", physics="native", observation="state")


@pytest.fixture(scope="module")
def starts(env):
    keys = jax.random.split(jax.random.key(7), STARTS)
    return jax.device_get(jax.jit(jax.vmap(lambda key: env.reset(key)[1]))(keys))


def test_every_joint_spans_at_least_19_degrees_both_ways(env, starts):
    home = env.arm.home_qpos[env.arm.qpos]
    offset = np.rad2deg(starts.physics.qpos[:, env.arm.qpos] - home)
    assert (offset.min(axis=0) <= -19.0).all()
    assert (offset.max(axis=0) >= 19.0).all()
    assert np.abs(offset).max() <= 20.001


def test_the_cube_covers_200_square_centimetres(env, starts):
    rectangle = env.scene.numbers("cube_rectangle", 4)
    centre, half = rectangle[:2], rectangle[2:]
    assert 4 * half.prod() == pytest.approx(0.02)
    offset = (starts.placement - centre) / half
    assert np.abs(offset).max() <= 1.0
    assert (offset.min(axis=0) < -0.99).all()
    assert (offset.max(axis=0) > 0.99).all()
    np.testing.assert_array_equal(
        starts.physics.qpos[:, env.task.cube_qpos : env.task.cube_qpos + 2], starts.placement
    )


def test_starts_can_be_wider_than_those_of_environment_b_and_a_stays_constant():
    wider = {"joint_noise_scale": 1.5, "rectangle_scale": 1.6}
    spans = {}
    for name in "AB":
        env = mjx_arm.make(name, physics="native", observation="state", **wider)
        keys = jax.random.split(jax.random.key(7), 2_000)
        starts = jax.device_get(jax.jit(jax.vmap(lambda key, env=env: env.reset(key)[1]))(keys))
        joints = np.rad2deg(np.ptp(starts.physics.qpos[:, env.arm.qpos], axis=0))
        spans[name] = (joints, np.ptp(starts.placement, axis=0))
    assert (spans["A"][0] == 0).all()
    assert (spans["A"][1] == 0).all()
    np.testing.assert_allclose(spans["B"][0], 60, rtol=0.05)
    np.testing.assert_allclose(spans["B"][1], [0.16, 0.32], rtol=0.05)


def test_few_samples_are_rejected_and_none_runs_out(starts):
    rejected = 1 - STARTS / starts.start_samples.sum()
    print(f"rejected: {100 * rejected:.1f} % of {starts.start_samples.sum()} samples")
    assert rejected < MOST_REJECTED
    assert starts.start_samples.max() < MAX_SAMPLES


def test_nothing_penetrates_anything(env, starts):
    model = env.scene.mj_model
    data, points = mujoco.MjData(model), np.zeros(6)
    body, parent = model.geom_bodyid, model.body_parentid
    near = [
        (a, b)
        for a in range(model.ngeom)
        for b in range(a)
        if body[a] != body[b]
        and parent[body[a]] != body[b]
        and parent[body[b]] != body[a]
        and {model.geom(a).name, model.geom(b).name} != {"table", "base"}
    ]
    # Neighbours overlap at their joint; the second body down does at the wrist, by design.
    at_home = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, at_home, model.key("home").id)
    mujoco.mj_forward(model, at_home)
    near = [
        (a, b) for a, b in near if mujoco.mj_geomDistance(model, at_home, a, b, 0.01, points) > 0
    ]
    assert len(near) > 50
    cube = {pair for pair in near if env.task.cube_geom in pair}
    assert len(cube) > 10
    deepest = np.inf
    for qpos in starts.physics.qpos[:: STARTS // 1000]:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        for a, b in near:
            deepest = min(deepest, mujoco.mj_geomDistance(model, data, a, b, 0.01, points))
    assert deepest > 0.0


def test_lowest_point_of_all_starts_is_above_the_table(env, starts):
    xpos, xmat = starts.physics.poses.geom_xpos, starts.physics.poses.geom_xmat
    fingers = [env.scene.mj_model.geom(f"{side}_finger").id for side in ("left", "right")]
    size = env.scene.mj_model.geom_size[fingers]
    lowest = xpos[:, fingers, 2] - (np.abs(xmat[:, fingers, 2, :]) * size).sum(axis=-1)
    assert lowest.min() > 0.0


def test_nothing_is_sampled_where_no_start_is_wanted(env):
    sample = jax.jit(jax.vmap(env.starts.sample))
    keys = jax.random.split(jax.random.key(0), 4)
    places = np.tile(env.arm.home_qpos[env.task.cube_qpos : env.task.cube_qpos + 2], (4, 1))
    wanted = np.asarray([True, False, False, True])
    *_, samples = sample(keys, places, wanted)
    np.testing.assert_array_equal(np.asarray(samples) > 0, wanted)
