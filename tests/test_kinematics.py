"""Poses are those of `mj_kinematics` and `mj_camlight`."""

from __future__ import annotations

import copy

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_arm.kinematics import make_camera_pose, make_kinematics
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


def test_a_ball_joint_is_rejected_by_name():
    model = mujoco.MjModel.from_xml_string("""
        <mujoco><worldbody>
          <body><joint name="wrist" type="ball"/><geom size="0.1"/></body>
        </worldbody></mujoco>
    """)
    with pytest.raises(ValueError, match="joint 'wrist' is a ball joint; supported are free"):
        make_kinematics(model)


def test_mocap_bodies_are_rejected():
    model = mujoco.MjModel.from_xml_string("""
        <mujoco><worldbody><body mocap="true"><geom size="0.1"/></body></worldbody></mujoco>
    """)
    with pytest.raises(ValueError, match="mocap bodies, which are not supported"):
        make_kinematics(model)


@pytest.mark.parametrize("quat", [[0, 0, 0, 0], [1e-20, 0, 0, 0], [0, -3, 0, 0], [1, 2, 3, 4]])
def test_any_quaternion_is_read_as_mujoco_reads_it(quat):
    model = odd()
    free = int(np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)[0])
    qpos = random_qpos(model, 1)[0]
    start = model.jnt_qposadr[free]
    qpos[start + 3 : start + 7] = quat
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    poses = make_kinematics(model)(jnp.asarray(qpos))
    np.testing.assert_allclose(poses.geom_xpos, data.geom_xpos, atol=TOLERANCE)
    np.testing.assert_allclose(poses.geom_xmat.reshape(-1, 9), data.geom_xmat, atol=TOLERANCE)


CAMERAS = ODD.replace(
    '<site name="tip"', '<camera name="hand" pos="0.1 0.2 0.3" euler="10 50 90"/><site name="tip"'
).replace("<worldbody>", '<worldbody><camera name="room" pos="1 2 3" euler="30 0 10"/>')

VARIES = {
    "geom_pos": (2, 0),
    "geom_quat": (2, 1),
    "body_pos": (1, 2),
    "body_quat": (2,),
    "cam_pos": (1, 0),
    "cam_quat": (1,),
    "geom_rgba": (0,),
}


def test_poses_vary_as_those_of_an_edited_model():
    model = mujoco.MjModel.from_xml_string(CAMERAS)
    random = np.random.default_rng(1)
    qpos = random_qpos(model, 20)
    params = {
        field: random.normal(size=(20, len(ids), getattr(model, field).shape[1]))
        for field, ids in VARIES.items()
    }
    for field in ("geom_quat", "cam_quat", "body_quat"):
        params[field] /= np.linalg.norm(params[field], axis=-1, keepdims=True)
    params = {field: values.astype(np.float32) for field, values in params.items()}
    kinematics = make_kinematics(model, VARIES)
    cameras = [make_camera_pose(model, name, VARIES) for name in ("room", "hand")]

    def everything(qpos, params):
        return kinematics(qpos, params), [camera(qpos, params) for camera in cameras]

    poses, views = jax.jit(jax.vmap(everything))(jnp.asarray(qpos), params)
    for row in range(20):
        edited = copy.copy(model)
        for field, ids in VARIES.items():
            getattr(edited, field)[list(ids)] = params[field][row]
        # The compiler's marks of equal frames, by which MuJoCo would ignore some of the edits.
        edited.geom_sameframe[:] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        data = mujoco.MjData(edited)
        data.qpos[:] = qpos[row]
        mujoco.mj_kinematics(edited, data)
        mujoco.mj_comPos(edited, data)
        mujoco.mj_camlight(edited, data)
        tolerance = 10 * TOLERANCE
        np.testing.assert_allclose(poses.geom_xpos[row], data.geom_xpos, atol=tolerance)
        xmat = data.geom_xmat.reshape(-1, 3, 3)
        np.testing.assert_allclose(poses.geom_xmat[row], xmat, atol=tolerance)
        np.testing.assert_allclose(poses.site_xpos[row], data.site_xpos, atol=tolerance)
        for camera, (pos, mat) in enumerate(views):
            np.testing.assert_allclose(pos[row], data.cam_xpos[camera], atol=tolerance)
            xmat = data.cam_xmat[camera].reshape(3, 3)
            np.testing.assert_allclose(mat[row], xmat, atol=tolerance)


def _chain(links: int) -> mujoco.MjModel:
    body = (
        '<body pos="0.1 0.02 0.3" euler="20 30 40"><joint axis="0 0 1"/>'
        '<geom size="0.1" pos="0.1 0 0"/>'
    )
    xml = f"<mujoco><worldbody>{body * links}{'</body>' * links}</worldbody></mujoco>"
    return mujoco.MjModel.from_xml_string(xml)


def _instructions(model: mujoco.MjModel) -> int:
    kinematics = jax.jit(jax.vmap(make_kinematics(model)))
    compiled = kinematics.lower(jnp.zeros((8, model.nq), jnp.float32)).compile()
    return sum(" = " in line for line in compiled.as_text().splitlines())


def test_compiled_code_grows_linearly_with_a_chain_of_tilted_frames():
    two, four, six = (_instructions(_chain(links)) for links in (2, 4, 6))
    assert 0 < six - four < 1.1 * (four - two)


def test_fields_that_poses_cannot_vary_by_are_rejected():
    for field in ("jnt_axis", "jnt_pos", "qpos0", "site_pos"):
        with pytest.raises(ValueError, match=f"'{field}' cannot vary by episode"):
            make_kinematics(odd(), {field: (0,)})
    with pytest.raises(ValueError, match="has the row 77"):
        make_kinematics(odd(), {"geom_pos": (77,)})
    with pytest.raises(ValueError, match="params lacks 'geom_pos'"):
        make_kinematics(odd(), {"geom_pos": (0,)})(jnp.zeros(odd().nq))


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ("none", r"unknown camera 'none': the scene has \['eye'\]"),
        ("eye", "camera 'eye' has the mode 'track'; supported is mode='fixed'"),
    ],
)
def test_other_cameras_are_rejected_by_name(camera, message):
    model = mujoco.MjModel.from_xml_string("""
        <mujoco><worldbody>
          <body><freejoint/><geom size="0.1"/><camera name="eye" mode="track"/></body>
        </worldbody></mujoco>
    """)
    with pytest.raises(ValueError, match=message):
        make_camera_pose(model, camera)
