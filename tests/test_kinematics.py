"""Poses are those of `mj_kinematics`."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_arm.kinematics import make_kinematics
from mjx_arm.scene import load_scene

TOLERANCE = 2e-6

# What the scenes do not have: joints off their body's frame, two joints of a body, tilted frames,
# joints whose zero is elsewhere, and a geom and a site of the world.
ODD = """
<mujoco>
  <worldbody>
    <geom name="ground" type="plane" size="1 1 0.1" pos="0.1 0.2 0.3" euler="5 10 15"/>
    <site name="world" pos="0.3 0.1 0.2"/>
    <body pos="0.1 0.2 0.3" euler="20 30 40">
      <joint type="hinge" axis="1 2 3" pos="0.1 0.05 0.02" ref="30"/>
      <joint type="slide" axis="0 1 1" ref="0.1"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0.1 0.1 0.1"/>
      <body pos="0.1 0 0.1" quat="0.5 0.5 -0.5 0.5">
        <joint type="hinge" axis="0 0 -1" pos="0 0.1 0"/>
        <geom type="box" size="0.1 0.1 0.1" pos="0.1 0.2 0.3" euler="10 20 30"/>
        <site name="tip" pos="0.1 0.1 0"/>
      </body>
    </body>
    <body pos="1 1 1">
      <freejoint/>
      <geom type="sphere" size="0.1" pos="0.05 0 0"/>
    </body>
  </worldbody>
</mujoco>
"""


def arm_cube() -> mujoco.MjModel:
    return load_scene("arm_cube").mj_model


def odd() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ODD)


def random_qpos(model: mujoco.MjModel, count: int) -> np.ndarray:
    """Of every joint's range, and quaternions that are not of unit length: `[count, nq]`."""
    random = np.random.default_rng(0)
    qpos = random.uniform(-1.5, 1.5, (count, model.nq))
    limited = model.jnt_limited.astype(bool)
    low, high = model.jnt_range[limited].T
    qpos[:, model.jnt_qposadr[limited]] = random.uniform(low, high, (count, len(low)))
    return qpos.astype(np.float32)


@pytest.mark.parametrize("make_model", [arm_cube, odd])
def test_poses_are_those_of_mujoco(make_model):
    model = make_model()
    qpos = random_qpos(model, 50)
    poses = jax.jit(jax.vmap(make_kinematics(model)))(jnp.asarray(qpos))
    data = mujoco.MjData(model)
    for row in range(len(qpos)):
        data.qpos[:] = qpos[row]
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(poses.geom_xpos[row], data.geom_xpos, atol=TOLERANCE)
        xmat = data.geom_xmat.reshape(-1, 3, 3)
        np.testing.assert_allclose(poses.geom_xmat[row], xmat, atol=TOLERANCE)
        np.testing.assert_allclose(poses.site_xpos[row], data.site_xpos, atol=TOLERANCE)


def test_nested_vmap_gives_the_same_as_flat():
    model = arm_cube()
    kinematics = make_kinematics(model)
    qpos = jnp.asarray(random_qpos(model, 12))
    flat = jax.vmap(kinematics)(qpos)
    nested = jax.vmap(jax.vmap(kinematics))(qpos.reshape(3, 4, -1))
    for one, other in zip(jax.tree.leaves(nested), jax.tree.leaves(flat), strict=True):
        assert one.dtype == jnp.float32
        np.testing.assert_allclose(one.reshape(other.shape), other, atol=1e-6)


def test_a_ball_joint_is_refused_by_name():
    model = mujoco.MjModel.from_xml_string("""
        <mujoco><worldbody>
          <body><joint name="wrist" type="ball"/><geom size="0.1"/></body>
        </worldbody></mujoco>
    """)
    with pytest.raises(ValueError, match="joint 'wrist' is a ball joint; supported are free"):
        make_kinematics(model)


def test_mocap_bodies_are_refused():
    model = mujoco.MjModel.from_xml_string("""
        <mujoco><worldbody><body mocap="true"><geom size="0.1"/></body></worldbody></mujoco>
    """)
    with pytest.raises(ValueError, match="mocap bodies, which are not supported"):
        make_kinematics(model)
