"""Servos with a time constant, whose activations outlive an iteration."""

from __future__ import annotations

import pathlib

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_arm.physics import compiler_options, make_physics

MOST_DIFFERENCE_OF_MJX = 1e-4
TARGET = np.deg2rad(30.0)

ONE_JOINT = """
<mujoco>
  <option timestep="0.01"><flag eulerdamp="disable"/></option>
  <worldbody>
    <body>
      <joint name="waist" axis="0 0 1" armature="0.5"/>
      <geom size="0.1" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator>
    <position joint="waist" kp="100" kv="15" timeconst="0.3" ctrlrange="-1 1"/>
    <intvelocity joint="waist" kp="1" actrange="-1 1"/>
  </actuator>
</mujoco>
"""


def plain_loop(model: mujoco.MjModel, qpos, act, ctrl, steps: int) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:], data.act[:], data.ctrl[:] = qpos, act, ctrl
    for _ in range(steps):
        mujoco.mj_step(model, data)
    return data


def run(physics, qpos, before, ctrl, iterations: int):
    step = jax.jit(physics.step, compiler_options=compiler_options(physics))
    state = physics.init(jnp.asarray(qpos), jnp.asarray(before))
    for _ in range(iterations):
        state = step(state, jnp.asarray(ctrl))
    return state


@pytest.mark.parametrize("backend", ["native", "mjx"])
def test_the_joint_goes_where_mujocos_goes(backend):
    model = mujoco.MjModel.from_xml_string(ONE_JOINT)
    physics = make_physics(model, backend, substeps=2)
    before, ctrl = np.asarray([0.1, 0.0], np.float32), np.asarray([TARGET, 0.01], np.float32)
    qpos = np.asarray([0.1], np.float32)
    for iterations in (1, 10, 100):
        state = run(physics, qpos, before, ctrl, iterations)
        data = plain_loop(model, qpos, before, ctrl, 2 * iterations)
        np.testing.assert_allclose(state.qpos, data.qpos, atol=MOST_DIFFERENCE_OF_MJX)
        if backend == "native":
            np.testing.assert_array_equal(state.qpos, data.qpos.astype(np.float32))
    assert data.qpos[0] > 0.9 * TARGET
    assert not state.diverged


def test_the_waist_of_the_arm_goes_where_mujocos_goes(ids):
    text = (pathlib.Path(__file__).parents[2] / "xml/arm_cube.xml").read_text()
    slower = text.replace('kv="62" inheritrange', 'kv="62" timeconst="0.1" inheritrange')
    assert slower != text
    model = mujoco.MjModel.from_xml_string(slower)
    physics = make_physics(model, "native", substeps=2)
    ctrl = ids.home_ctrl.copy()
    ctrl[0] = TARGET
    state = run(physics, ids.home_qpos, ids.home_ctrl, ctrl, 60)
    slow = ids.home_ctrl[model.actuator_actadr >= 0]
    data = plain_loop(model, ids.home_qpos, slow, ctrl, 120)
    np.testing.assert_array_equal(state.qpos, data.qpos.astype(np.float32))
    assert abs(float(state.qpos[0]) - TARGET) < 2e-3


@pytest.mark.parametrize("backend", ["native", "mjx"])
def test_filters_start_settled_and_integrators_at_zero(backend):
    model = mujoco.MjModel.from_xml_string(ONE_JOINT)
    physics = make_physics(model, backend, substeps=1)
    state = physics.init(jnp.zeros(1), jnp.asarray([3.0, 0.5]))
    values = np.asarray(state.integration)
    if backend == "native":
        values = values.view(np.float64)[3:5]  # after time, position and velocity
    else:
        values = values[1:]
    np.testing.assert_array_equal(values, [1.0, 0.0])


@pytest.mark.parametrize("backend", ["native", "mjx"])
def test_an_activation_that_is_not_finite_ends_the_episode(backend):
    model = mujoco.MjModel.from_xml_string(ONE_JOINT)
    physics = make_physics(model, backend, substeps=1)
    ctrl = jnp.asarray([0.5, 0.0])
    state = physics.init(jnp.zeros(1), ctrl)
    words = np.array(state.integration)
    if backend == "native":
        words.view(np.float64)[3] = np.nan
    else:
        words[1] = np.nan
    after = jax.jit(physics.step)(state.replace(integration=jnp.asarray(words)), ctrl)
    assert after.diverged
    np.testing.assert_array_equal(after.qpos, state.qpos)
