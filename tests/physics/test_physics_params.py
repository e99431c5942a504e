"""What varies by episode: both backends simulate the model that a user would have edited."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from physics_lab import GRASP_JOINTS, GRASP_RADIUS

from mjx_arm.physics import FIELDS, Physics, PhysicsState, compiler_options, make_physics
from mjx_arm.physics import mjx as mjx_backend
from mjx_arm.physics import native as native_backend
from mjx_arm.physics.base import DERIVING_FIELDS
from mjx_arm.varies import own_params

# After 5 iterations that close the gripper around a cube, with 100 random params: rad and m. MJX
# leaves MuJoCo's way in a few grasps, also where the model was edited instead.
MOST_ANGLE_DIFFERENCE = 2e-5
MOST_PLACE_DIFFERENCE = 1e-4
MOST_OUTLIERS = 4
MOST_DIFFERENCE_OF_EDITED = 5e-5
CONSTANT_TOLERANCE = 2e-5

CHAIN = """
<mujoco>
  <option timestep="0.005"><flag eulerdamp="disable"/></option>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <body name="turret" pos="0 0 1">
      <joint name="yaw" axis="0 0 1" armature="0.1"/>
      <geom name="turret" type="cylinder" size="0.1 0.2"/>
      <body name="slider" pos="0.1 0 0.2" quat="0.9 0.1 0.2 0">
        <joint name="slide" type="slide" axis="1 0 0"/>
        <geom name="slider" type="ellipsoid" size="0.1 0.05 0.2"/>
        <geom name="tip" type="capsule" size="0.05 0.1" pos="0.2 0 0"/>
        <site name="tip" pos="0.3 0 0"/>
      </body>
    </body>
    <body name="rail" pos="0 1 1">
      <joint name="rail" type="slide" axis="0 0 1" armature="0.3"/>
      <geom name="rail" type="box" size="0.1 0.2 0.1"/>
    </body>
    <body name="ball" pos="1 0 0.5"><freejoint/><geom name="ball" size="0.1"/></body>
    <site name="post" pos="0 0 2"/>
  </worldbody>
  <contact><pair geom1="ball" geom2="floor"/></contact>
  <tendon>
    <fixed name="sum"><joint joint="yaw" coef="0.5"/><joint joint="slide" coef="2"/></fixed>
    <spatial name="rope"><site site="tip"/><site site="post"/></spatial>
  </tendon>
  <actuator><motor joint="yaw" gear="3"/><motor tendon="rope"/></actuator>
</mujoco>
"""


@pytest.fixture(scope="module")
def chain() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(CHAIN)


def all_rows(model: mujoco.MjModel, *fields: str) -> dict[str, tuple[int, ...]]:
    return {field: tuple(range(len(getattr(model, field)))) for field in fields}


def arm_varies(model: mujoco.MjModel) -> dict[str, tuple[int, ...]]:
    cube, geom = model.body("cube").id, model.geom("cube").id
    servos = (0, 1, 4, model.actuator("gripper").id)
    return {
        "geom_size": (geom,),
        "geom_friction": (geom,),
        "geom_rgba": (geom,),
        "body_mass": (cube, model.body("lower_forearm").id),
        "body_inertia": (cube, model.body("lower_forearm").id),
        "pair_friction": tuple(range(model.npair)),
        "actuator_gainprm": servos,
        "actuator_biasprm": servos,
        "dof_damping": (0, 3),
        "dof_armature": (0, 3),
    }


def random_params(
    model: mujoco.MjModel, varies: dict[str, tuple[int, ...]], count: int, seed: int
) -> dict[str, np.ndarray]:
    """The model's own values, each scaled by 0.8 to 1.25 and unit quaternions again."""
    random = np.random.default_rng(seed)
    params = {}
    for field, ids in varies.items():
        own = np.asarray(getattr(model, field)[list(ids)], np.float32)
        values = np.tile(own, (count, *[1] * own.ndim))
        if field.endswith("_quat"):
            values = values + random.normal(size=values.shape) * 0.1
            values /= np.linalg.norm(values, axis=-1, keepdims=True)
        elif field == "dof_damping":
            values = random.uniform(0.0, 1.0, values.shape)
        elif field.endswith("_pos"):
            values = values + random.uniform(-0.01, 0.01, values.shape)
        else:
            shape = (count, len(ids), *[1] * (own.ndim - 1))
            values = values * np.exp(random.uniform(np.log(0.8), np.log(1.25), shape))
        params[field] = values.astype(np.float32)
    if "actuator_gainprm" in params:  # a position servo pulls back by what it pushes with
        params["actuator_biasprm"][..., 1] = -params["actuator_gainprm"][..., 0]
    return params


def edited(model: mujoco.MjModel, varies, params, row: int) -> mujoco.MjModel:
    """The model that a user would edit by hand."""
    model = copy.copy(model)
    for field, ids in varies.items():
        getattr(model, field)[list(ids)] = params[field][row]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def plain_loop(model: mujoco.MjModel, qpos, ctrl, steps: int) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:], data.ctrl[:] = qpos, ctrl
    for _ in range(steps):
        mujoco.mj_step(model, data)
    return data


def grasping(
    ids, model: mujoco.MjModel, count: int, lifted: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Grippers that shut around a cube, on the table or in the air, while the arm turns a little.

    Returns `qpos [count, nq]` and `ctrl [count, nu]`.
    """
    qpos = np.tile(ids.home_qpos, (count, 1))
    ctrl = np.tile(ids.home_ctrl, (count, 1))
    qpos[:, ids.arm_qpos] = ctrl[:, ids.arm_ctrl] = GRASP_JOINTS
    qpos[:, ids.cube_qpos : ids.cube_qpos + 2] = GRASP_RADIUS, 0.0
    qpos[:, ids.finger_qpos] = 0.034
    if lifted > 0.0:
        qpos[:, ids.arm_qpos[1]] -= lifted
        ctrl[:, ids.arm_ctrl[1]] -= lifted
        data = plain_loop(model, qpos[0], ctrl[0], 0)
        mujoco.mj_kinematics(model, data)
        quat = data.xquat[model.site_bodyid[ids.grasp_site]]
        qpos[:, ids.cube_qpos : ids.cube_qpos + 7] = *data.site_xpos[ids.grasp_site], *quat
    ctrl[:, ids.gripper_ctrl] = ids.ctrl_range[ids.gripper_ctrl, 0]
    ctrl[:, ids.arm_ctrl[[0, 2]]] += np.float32(0.02)
    return qpos.astype(np.float32), ctrl.astype(np.float32)


@functools.cache
def compiled(physics: Physics) -> tuple[Callable, Callable]:
    options = compiler_options(physics)
    step = jax.jit(jax.vmap(physics.step), compiler_options=options)
    return jax.jit(jax.vmap(physics.init)), step


def run(physics: Physics, qpos, ctrl, params, iterations: int) -> PhysicsState:
    init, step = compiled(physics)
    params = jax.tree.map(jnp.asarray, params)
    qpos, ctrl = jnp.asarray(qpos), jnp.asarray(ctrl)
    state = init(qpos, ctrl, params)
    for _ in range(iterations):
        state = step(state, ctrl, params)
    return state


def assert_is_the_plain_loop(model, varies, params, state, qpos, ctrl, steps) -> int:
    contacts = 0
    for row in range(len(qpos)):
        other = edited(model, varies, params, row)
        data = plain_loop(other, qpos[row], ctrl[row], steps)
        np.testing.assert_array_equal(state.qpos[row], data.qpos.astype(np.float32))
        np.testing.assert_array_equal(state.qvel[row], data.qvel.astype(np.float32))
        mujoco.mj_kinematics(other, data)
        np.testing.assert_array_equal(state.poses.geom_xpos[row], data.geom_xpos.astype(np.float32))
        contacts = max(contacts, data.ncon)
    return contacts


class TestNative:
    """Of native, to the bit."""

    def test_it_is_the_edited_model(self, scene, ids):
        model, varies = scene.mj_model, arm_varies(scene.mj_model)
        physics = make_physics(model, "native", substeps=2, varies=varies)
        qpos, ctrl = grasping(ids, model, 8)
        params = random_params(model, varies, 8, seed=0)
        state = run(physics, qpos, ctrl, params, 20)
        assert not state.diverged.any()
        contacts = assert_is_the_plain_loop(model, varies, params, state, qpos, ctrl, 40)
        assert contacts >= 6
        assert len(np.unique(np.asarray(state.qpos), axis=0)) == 8

    def test_frames_and_sizes_too(self, chain):
        fields = ("geom_pos", "geom_quat", "body_pos", "body_quat", "geom_size", "body_mass")
        varies = all_rows(chain, *fields)
        physics = make_physics(chain, "native", substeps=5, varies=varies)
        params = random_params(chain, varies, 4, seed=1)
        qpos = np.tile(chain.qpos0, (4, 1)).astype(np.float32)
        ctrl = np.ones((4, chain.nu), np.float32)
        start = jax.vmap(physics.init)(jnp.asarray(qpos), jnp.asarray(ctrl), params)
        for row in range(4):
            data = plain_loop(edited(chain, varies, params, row), qpos[row], ctrl[row], 0)
            mujoco.mj_kinematics(edited(chain, varies, params, row), data)
            np.testing.assert_allclose(start.poses.geom_xpos[row], data.geom_xpos, atol=2e-6)
        state = run(physics, qpos, ctrl, params, 20)
        assert_is_the_plain_loop(chain, varies, params, state, qpos, ctrl, 100)

    def test_nothing_is_remembered_from_call_to_call(self, scene, ids):
        model, varies = scene.mj_model, arm_varies(scene.mj_model)
        physics = make_physics(model, "native", substeps=2, varies=varies)
        qpos, ctrl = grasping(ids, model, 4)
        own = own_params(model, varies)
        own = jax.tree.map(lambda x: np.tile(np.asarray(x), (4, *[1] * x.ndim)), own)
        first = run(physics, qpos, ctrl, own, 3)
        other = random_params(model, varies, 4, seed=2)
        assert (run(physics, qpos, ctrl, other, 3).qpos != first.qpos).any()
        again = run(physics, qpos, ctrl, own, 3)
        np.testing.assert_array_equal(first.integration, again.integration)
        swapped = jax.tree.map(lambda x: x[::-1], other)
        there = run(physics, qpos, ctrl, swapped, 3)
        back = run(physics, qpos, ctrl, other, 3)
        np.testing.assert_array_equal(there.integration[::-1], back.integration)

    @pytest.mark.parametrize("value", [np.nan, -1.0])
    def test_invalid_params_end_their_own_episode_only(self, chain, value):
        varies = {"body_mass": (1, 4), "geom_size": (1,), "body_pos": (1,)}
        physics = make_physics(chain, "native", substeps=2, varies=varies)
        qpos = np.tile(chain.qpos0, (3, 1)).astype(np.float32)
        ctrl = np.ones((3, chain.nu), np.float32)
        params = random_params(chain, varies, 3, seed=3)
        expected = run(physics, qpos, ctrl, params, 2)
        broken = jax.tree.map(np.copy, params)
        broken["body_mass"][1] = value
        state = run(physics, qpos, ctrl, broken, 2)
        np.testing.assert_array_equal(state.diverged, [False, True, False])
        np.testing.assert_array_equal(state.qpos[1], qpos[1])
        assert np.isfinite(state.poses.geom_xpos).all()
        for row in (0, 2):
            np.testing.assert_array_equal(state.integration[row], expected.integration[row])
        mended = run(physics, qpos, ctrl, params, 2)
        np.testing.assert_array_equal(mended.integration, expected.integration)

    def test_only_what_varies_lengthens_the_row(self, scene, ids, monkeypatch):
        widths = []

        def spy(pool, layout, rows, out, *, substeps):
            widths.append(rows.shape[-1])
            out[...] = 0

        monkeypatch.setattr(native_backend, "_step_rows", spy)
        model = scene.mj_model
        for varies in ({}, {"geom_rgba": (0,)}, {"body_mass": (1, 2), "geom_size": (3,)}):
            physics = make_physics(model, "native", substeps=3, varies=varies)
            params = own_params(model, varies)
            state = physics.init(jnp.asarray(ids.home_qpos), jnp.asarray(ids.home_ctrl), params)
            jax.block_until_ready(physics.step(state, jnp.asarray(ids.home_ctrl), params))
        # Time, positions, velocities and warm start are float64, controls and params float32.
        plain = 2 * (1 + model.nq + 2 * model.nv) + model.nu
        assert widths == [plain, plain, plain + 2 + 3]

    def test_more_memory_is_announced(self, scene):
        plain, varied = (
            make_physics(scene.mj_model, "native", substeps=2, varies=varies).host_memory(1000)
            for varies in (None, {"body_mass": (1,)})
        )
        assert varied > plain + 1000 * 8 * scene.mj_model.nbody


class TestMjx:
    """Of MJX, against MuJoCo C."""

    def test_the_derived_constants_are_those_of_mujoco(self, chain):
        fields = [f for f in sorted(DERIVING_FIELDS) if f != "geom_quat"]
        varies = all_rows(chain, *fields)
        params = random_params(chain, varies, 1, seed=4)
        model, data = mjx_backend._put(chain, "jax")

        def derive(params):
            full = {field: params[field][0] for field in fields}
            with jax.numpy_dtype_promotion("standard"):
                return mjx_backend._derive(chain, model.replace(**full), data)

        derived, expected = jax.jit(derive)(params), edited(chain, varies, params, 0)
        names = ["body_subtreemass", "geom_rbound", "tendon_length0", "actuator_acc0"]
        names += ["body_invweight0", "dof_invweight0", "tendon_invweight0"]
        for name in names:
            actual, right = np.asarray(getattr(derived, name)), getattr(expected, name)
            np.testing.assert_allclose(
                actual, right, rtol=CONSTANT_TOLERANCE, atol=1e-6, err_msg=name
            )
            assert not np.allclose(getattr(chain, name), right, rtol=1e-2), name

    def test_both_backends_agree_on_100_random_params(self, scene, ids):
        model, varies = scene.mj_model, arm_varies(scene.mj_model)
        # In the air, because MJX has other contacts of a box with a plane than MuJoCo.
        qpos, ctrl = grasping(ids, model, 100, lifted=0.3)
        params = random_params(model, varies, 100, seed=5)
        ends = {}
        for backend in ("native", "mjx"):
            physics = make_physics(model, backend, substeps=2, varies=varies)
            ends[backend] = run(physics, qpos, ctrl, params, 5)
            assert not ends[backend].diverged.any()
        angles, places = difference(ids, ends["native"], ends["mjx"])
        assert np.sum(angles > MOST_ANGLE_DIFFERENCE) <= MOST_OUTLIERS
        assert np.sum(places > MOST_PLACE_DIFFERENCE) <= MOST_OUTLIERS
        # Params that are not given to one backend make a difference that the test sees.
        plain = make_physics(model, "native", substeps=2)
        angles, places = difference(ids, run(plain, qpos, ctrl, {}, 5), ends["mjx"])
        assert np.median(angles) > MOST_ANGLE_DIFFERENCE
        assert np.sum(places > MOST_PLACE_DIFFERENCE) > 50

    @pytest.mark.slow
    def test_it_is_mjx_of_the_edited_model(self, scene, ids):
        model, varies = scene.mj_model, arm_varies(scene.mj_model)
        qpos, ctrl = grasping(ids, model, 20, lifted=0.3)
        params = random_params(model, varies, 20, seed=5)
        physics = make_physics(model, "mjx", substeps=2, varies=varies)
        varied = run(physics, qpos, ctrl, params, 5)
        _, template = mjx_backend._put(model, "jax")
        models = [mjx_backend._put(edited(model, varies, params, i), "jax")[0] for i in range(20)]
        leaves = [jnp.stack(x) for x in zip(*map(jax.tree.leaves, models), strict=True)]
        stacked = jax.tree.unflatten(jax.tree.structure(models[0]), leaves)

        def ten_steps(mjx_model, qpos, ctrl):
            data = template.replace(qpos=qpos, ctrl=ctrl)
            with jax.numpy_dtype_promotion("standard"), jax.default_matmul_precision("highest"):
                step = functools.partial(mjx_backend.mjx.step, mjx_model)
                return jax.lax.fori_loop(0, 10, lambda _, data: step(data), data).qpos

        options = compiler_options(physics)
        right = jax.jit(jax.vmap(ten_steps), compiler_options=options)(stacked, qpos, ctrl)
        np.testing.assert_allclose(varied.qpos, right, atol=MOST_DIFFERENCE_OF_EDITED)


def difference(ids, one, other) -> tuple[np.ndarray, np.ndarray]:
    """Of 100 simulations: most of the arm's angles, rad, and of the places of geoms, m."""
    angles = np.abs(np.asarray(one.qpos - other.qpos))[:, ids.arm_qpos].max(axis=-1)
    places = np.asarray(one.poses.geom_xpos - other.poses.geom_xpos)
    return angles, np.linalg.norm(places, axis=-1).max(axis=-1)


@pytest.mark.parametrize("backend", ["native", "mjx"])
class TestRejections:
    """Named when the physics is made, or when it is traced."""

    @pytest.mark.parametrize(
        ("varies", "message"),
        [
            ({"qpos0": (0,)}, "physics cannot vary 'qpos0' by episode: give one of actuator_bias"),
            ({"geom_margin": (0,)}, "physics cannot vary 'geom_margin' by episode"),
            ({"body_mas": (0,)}, "'body_mas' is not a float array"),
            ({"body_mass": (99,)}, "99"),
        ],
    )
    def test_fields(self, chain, backend, varies, message):
        with pytest.raises(ValueError, match=message):
            make_physics(chain, backend, substeps=1, varies=varies)

    def test_params(self, chain, backend):
        physics = make_physics(chain, backend, substeps=1, varies={"body_mass": (1, 2)})
        assert physics.varies == {"body_mass": (1, 2)}
        qpos, ctrl = jnp.asarray(chain.qpos0, jnp.float32), jnp.zeros(chain.nu)
        with pytest.raises(ValueError, match=r"params need 'body_mass', \[2\] float32"):
            physics.init(qpos, ctrl)
        state = physics.init(qpos, ctrl, {"body_mass": jnp.ones(2)})
        with pytest.raises(ValueError, match=r"'body_mass' must be \[2\], got \[3\]"):
            physics.step(state, ctrl, {"body_mass": jnp.ones(3)})

    def test_fields_of_the_image_are_ignored(self, chain, backend):
        varies = {"geom_rgba": (1,), "headlight_ambient": (0,)}
        assert make_physics(chain, backend, substeps=1, varies=varies).varies == {}


def test_a_mesh_has_no_size_to_vary():
    model = mujoco.MjModel.from_xml_string("""
        <mujoco>
          <asset><mesh name="m" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/></asset>
          <worldbody><body><freejoint/><geom name="m" type="mesh" mesh="m"/></body></worldbody>
        </mujoco>
    """)
    with pytest.raises(ValueError, match=r"'geom_size' of geom 0 \('m'\): only primitives"):
        make_physics(model, "native", substeps=1, varies={"geom_size": (0,)})


def test_the_deriving_fields_are_those_of_mujoco():
    assert set(mujoco.MjModel._setconst_inputs) & FIELDS == DERIVING_FIELDS


def test_warp_does_not_vary(chain):
    with pytest.raises(ValueError, match="'mjx-warp' cannot vary body_mass by episode"):
        mjx_backend.make_mjx(chain, 1, {"body_mass": (1,)}, impl="warp")
