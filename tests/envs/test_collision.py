from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_arm.envs.collision import MARGIN, Obstacle, make_self_collision
from mjx_arm.kinematics import make_kinematics
from mjx_arm.scene import load_scene

POSES = 600
# Corners are cut by at most 2.2 mm each; what the projections leave makes clearances smaller.
MOST_TOO_LARGE = 0.0045

OTHER_ARM = """
<mujoco>
  <worldbody>
    <geom name="wall" type="plane" size="1 1 0.1" pos="-0.5 0 0" zaxis="1 0 0"/>
    <geom name="post" type="cylinder" size="0.04 0.1" pos="0.25 0.2 0.1"/>
    <body name="one" pos="0 0 0.2">
      <joint axis="0 0 1" range="-143 143"/>
      <geom name="first" type="box" size="0.12 0.03 0.02" pos="0.12 0 0"/>
      <body name="two" pos="0.26 0 0" euler="10 20 30">
        <joint axis="0 1 0" range="-160 160"/>
        <geom name="second" type="cylinder" size="0.025 0.08" pos="0.1 0 0" euler="0 90 0"/>
        <body name="three" pos="0.2 0 0">
          <joint axis="0 0 1" range="-160 160"/>
          <geom name="third" type="capsule" size="0.02" fromto="0.05 0 0 0.2 0 0"/>
          <geom name="tip" type="sphere" size="0.03" pos="0.22 0 0"/>
          <geom name="guard" group="3" type="sphere" size="0.2"/>
        </body>
      </body>
    </body>
    <body name="ball" pos="0.4 -0.2 0.2"><freejoint/><geom name="ball" size="0.03"/></body>
  </worldbody>
</mujoco>
"""


def models() -> dict[str, mujoco.MjModel]:
    return {
        "arm_cube": load_scene("arm_cube").mj_model,
        "other": mujoco.MjModel.from_xml_string(OTHER_ARM),
    }


def random_poses(model: mujoco.MjModel) -> np.ndarray:
    random = np.random.default_rng(0)
    home = model.key_qpos[0] if model.nkey else model.qpos0
    qpos = np.tile(home, (POSES, 1)).astype(np.float32)
    for joint in np.flatnonzero(model.jnt_type != mujoco.mjtJoint.mjJNT_FREE):
        address = model.jnt_qposadr[joint]
        qpos[:, address] = random.uniform(*model.jnt_range[joint], POSES)
    return qpos


def by_mujoco(model: mujoco.MjModel, qpos: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    data, points, rows = mujoco.MjData(model), np.zeros(6), []
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        rows.append([mujoco.mj_geomDistance(model, data, a, b, 5.0, points) for a, b in pairs])
    return np.asarray(rows)


@pytest.mark.parametrize("name", ["arm_cube", "other"])
def test_clearances_agree_with_mujoco(name):
    model = models()[name]
    collision, kinematics = make_self_collision(model), jax.jit(make_kinematics(model))
    qpos = random_poses(model)
    actual = np.asarray(jax.jit(jax.vmap(lambda q: collision.clearances(kinematics(q))))(qpos))
    expected = by_mujoco(model, qpos, collision.pairs)
    apart = expected > 0
    assert (actual - expected)[apart].max() < MOST_TOO_LARGE
    near = apart & (expected < 0.03)
    assert near.sum() > 100
    assert np.quantile((expected - actual)[near], 0.99) < 0.008
    # No pose that overlaps is called free, and few that are clearly free are not.
    free = (actual >= MARGIN).all(axis=1)
    overlaps = (expected < -1e-4).any(axis=1)
    assert overlaps.sum() > 50
    assert not (free & overlaps).any()
    clear = (expected > MARGIN + 0.003).all(axis=1)
    assert free[clear].mean() > 0.97


@pytest.mark.parametrize("name", ["arm_cube", "other"])
def test_every_pair_that_overlaps_in_some_pose_is_looked_at(name):
    model = models()[name]
    collision = make_self_collision(model)
    geoms = {int(g) for g in collision.pairs.ravel()}
    assert all(model.geom_group[g] < 3 for g in geoms)
    looked_at = {frozenset(pair) for pair in collision.pairs.tolist()}
    named = {frozenset(model.geom(g).name for g in pair) for pair in looked_at}
    expected = {
        "arm_cube": [("table", "wrist"), ("base", "palm"), ("upper_arm", "left_finger")],
        "other": [("wall", "tip"), ("post", "tip"), ("first", "third")],
    }[name]
    assert {frozenset(pair) for pair in expected} <= named
    assert frozenset(("first", "second")) not in named
    assert not any({"cube", "ball", "guard"} & pair for pair in named)


def test_home_is_free():
    model = models()["arm_cube"]
    poses = jax.jit(make_kinematics(model))(jnp.asarray(model.key_qpos[0], jnp.float32))
    assert make_self_collision(model).is_free(poses)


def test_a_command_out_of_the_table_is_never_blocked():
    model = models()["arm_cube"]
    collision, kinematics = make_self_collision(model), jax.jit(make_kinematics(model))
    home = model.key_qpos[0].astype(np.float32)
    lowest = np.flatnonzero([model.joint(j).name == "shoulder" for j in range(model.njnt)])[0]

    def qpos_at(degrees: float):
        qpos = home.copy()
        qpos[model.jnt_qposadr[lowest]] += np.deg2rad(degrees)
        return jnp.asarray(qpos)

    def poses(degrees: float):
        return kinematics(qpos_at(degrees))

    def links(degrees):
        of_all = poses(degrees)
        return of_all.replace(
            geom_xpos=of_all.geom_xpos[collision.geoms], geom_xmat=of_all.geom_xmat[collision.geoms]
        )

    assert collision.is_free(poses(0))
    assert not collision.is_free(poses(40))
    of_links = make_kinematics(model, geoms=collision.geoms.tolist())
    for last, now, blocked in ((39, 40, True), (40, 39, False), (40, 40, False), (0, 1, False)):
        assert collision.is_blocked(links(last), links(now)) == blocked
        assert collision.is_blocked(qpos_at(last), links(now), of_links) == blocked


def test_an_obstacle_is_a_sphere_at_its_geom():
    model = models()["arm_cube"]
    cube, palm = model.geom("cube").id, model.geom("palm").id
    collision = make_self_collision(model, obstacles=[Obstacle(cube, 0.03)], margin=0.002)
    kinematics = jax.jit(make_kinematics(model))
    qpos = model.key_qpos[0].astype(np.float32)
    place = model.jnt_qposadr[model.joint("cube").id]
    poses = kinematics(jnp.asarray(qpos))
    assert collision.is_free(poses)
    qpos[place : place + 3] = poses.geom_xpos[palm]
    assert not collision.is_free(kinematics(jnp.asarray(qpos)))


def test_nested_vmap_and_scan_give_the_same():
    model = models()["arm_cube"]
    collision, kinematics = make_self_collision(model), jax.jit(make_kinematics(model))
    poses = jax.vmap(kinematics)(random_poses(model)[:6])
    flat = jax.jit(jax.vmap(collision.clearances))(poses)
    nested = jax.tree.map(lambda x: x.reshape(2, 3, *x.shape[1:]), poses)
    twice = jax.jit(jax.vmap(jax.vmap(collision.clearances)))(nested)
    np.testing.assert_allclose(twice.reshape(flat.shape), flat, atol=1e-6)
    one = jax.jit(collision.clearances)(jax.tree.map(lambda x: x[2], poses))
    np.testing.assert_allclose(one, flat[2], atol=1e-6)


def test_commands_of_a_batch_are_blocked_one_by_one():
    model = models()["arm_cube"]
    collision, kinematics = make_self_collision(model), make_kinematics(model)
    qpos = jnp.asarray(random_poses(model)[:64])
    # Some come nearer to something, others go away from it.
    arm = qpos.at[:, : model.nu].add(jnp.where(jnp.arange(64) % 2 == 0, 0.1, -0.1)[:, None])
    poses = [jax.vmap(kinematics)(x) for x in (qpos, arm)]
    now, links = (
        x.replace(
            geom_xpos=x.geom_xpos[:, collision.geoms], geom_xmat=x.geom_xmat[:, collision.geoms]
        )
        for x in poses
    )
    before, after = (np.asarray(jax.vmap(collision.clearances)(x)) for x in poses)
    wanted = ((after < collision.margin) & (after < before - 5e-6)).any(axis=-1)
    assert 5 < wanted.sum() < 59
    batch = jax.jit(jax.vmap(collision.is_blocked))(now, links)
    np.testing.assert_array_equal(batch, wanted)
    nested = jax.tree.map(lambda x: x.reshape(4, 16, *x.shape[1:]), (now, links))
    twice = jax.jit(jax.vmap(jax.vmap(collision.is_blocked)))(*nested)
    np.testing.assert_array_equal(twice.reshape(-1), wanted)
    free = np.flatnonzero(~(after < collision.margin).any(axis=-1))[0]
    for index in (free, np.flatnonzero(wanted)[0]):
        row = jax.tree.map(lambda x, index=index: x[index], (now, links))
        assert jax.jit(collision.is_blocked)(*row) == wanted[index]


def test_a_home_that_collides_is_rejected():
    model = models()["arm_cube"]
    home = model.key_qpos[0].copy()
    home[1] += 0.8
    with pytest.raises(ValueError, match=r"mm apart at home: give a home where the arm is free"):
        make_self_collision(model, home=home)


def test_an_ellipsoid_is_rejected():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint/><geom name="egg" type="ellipsoid" size="1 2 3"/></body>'
        "</worldbody></mujoco>"
    )
    with pytest.raises(ValueError, match="geom 'egg' is a mjGEOM_ELLIPSOID"):
        make_self_collision(model)
