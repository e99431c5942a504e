"""The desk scene has the arm, the cube and the ids of the plain one."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from mjx_arm.scene import load_scene

# What only the image depends on, and what MuJoCo derives from the whole of a scene.
IMAGE = ("cam_", "light_", "mat_", "tex_", "geom_rgba", "geom_matid", "names", "name_", "text_")
DERIVED = ("bvh_", "mesh_", "oct_", "body_bvh", "paths")
KINDS = ("body", "jnt", "geom", "site", "actuator", "pair", "eq", "tendon", "key", "numeric")
OBJECTS = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "jnt": mujoco.mjtObj.mjOBJ_JOINT,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "site": mujoco.mjtObj.mjOBJ_SITE,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "tendon": mujoco.mjtObj.mjOBJ_TENDON,
    "key": mujoco.mjtObj.mjOBJ_KEY,
    "numeric": mujoco.mjtObj.mjOBJ_NUMERIC,
    "camera": mujoco.mjtObj.mjOBJ_CAMERA,
}


@pytest.fixture(scope="module")
def models() -> tuple[mujoco.MjModel, mujoco.MjModel]:
    return load_scene("arm_cube").mj_model, load_scene("arm_cube_desk").mj_model


def test_every_name_has_the_same_id(models) -> None:
    plain, desk = models
    for kind, number in OBJECTS.items():
        count = plain.ncam if kind == "camera" else getattr(plain, f"n{_count(kind)}")
        assert count > 0, kind
        for i in range(count):
            name = mujoco.mj_id2name(plain, number, i)
            assert mujoco.mj_id2name(desk, number, i) == name, (kind, i)


def _count(kind: str) -> str:
    return {"actuator": "u"}.get(kind, kind)


def test_every_number_of_the_physics_is_the_same(models) -> None:
    plain, desk = models
    compared = 0
    for field in dir(plain):
        values = getattr(plain, field)
        if field.startswith(IMAGE + DERIVED) or not isinstance(values, np.ndarray):
            continue
        if not field.startswith((*KINDS, "dof_", "qpos", "exclude", "wrap")):
            continue
        other = getattr(desk, field)
        np.testing.assert_array_equal(other[: len(values)], values, err_msg=field)
        compared += 1
    assert compared > 100
    for field in ("timestep", "integrator", "cone", "impratio", "iterations", "disableflags"):
        assert getattr(plain.opt, field) == getattr(desk.opt, field)
    assert (desk.nq, desk.nu, desk.npair) == (plain.nq, plain.nu, plain.npair)


def test_what_is_new_stands_still_and_touches_nothing(models) -> None:
    plain, desk = models
    new = slice(plain.ngeom, None)
    assert desk.nbody == plain.nbody + 1
    assert len(desk.geom_bodyid[new]) > 3
    assert (desk.body_weldid[desk.geom_bodyid[new]] == 0).all()
    assert not desk.geom_contype[new].any()
    assert not desk.geom_conaffinity[new].any()


def test_the_clutter_is_out_of_reach(models) -> None:
    """Of the arm's geoms only those of the black box could ever block it."""
    from mjx_arm.envs.collision import make_self_collision

    plain, desk = models
    pairs = make_self_collision(desk, home=desk.key_qpos[0]).pairs
    reached = {desk.geom(int(i)).name for i in pairs.ravel() if i >= plain.ngeom}
    assert reached == {"black_box"}
