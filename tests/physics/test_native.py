"""The native backend is MuJoCo, to the bit, for any number of callers."""

from __future__ import annotations

import subprocess
import sys
import textwrap
import threading

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from physics_lab import HOLDING, NUM_ENVS, grasp_starts, make_lab, scan_of

from mjx_arm.physics import make_physics, native
from mjx_arm.physics.base import check_model
from mjx_arm.physics.native import BatchPool, make_native

_CARRIED = (
    mujoco.mjtState.mjSTATE_TIME
    | mujoco.mjtState.mjSTATE_QPOS
    | mujoco.mjtState.mjSTATE_QVEL
    | mujoco.mjtState.mjSTATE_WARMSTART
)

# The step of a box into the ground needs more memory than this, that of a box in the air does not.
CRAMPED = """
<mujoco>
  <size memory="8K"/>
  <option timestep="0.01"><flag autoreset="disable"/></option>
  <worldbody>
    <geom type="plane" size="1 1 0.1"/>
    <body><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def lab():
    return make_lab("native")


def grasping_controls(lab, length: int) -> np.ndarray:
    """Shuts the gripper around a cube, lifts and shakes it: `[length, N, nu] float32`."""
    _, ctrl = grasp_starts(lab)
    controls = np.tile(ctrl, (length, 1, 1)).astype(np.float32)
    controls[2:, HOLDING, lab.ids.gripper_ctrl] = lab.ids.ctrl_range[lab.ids.gripper_ctrl, 0]
    shaking = np.random.default_rng(0).normal(size=(length, NUM_ENVS, 6)) * 0.01
    lifting = -np.deg2rad(1.0) * np.maximum(np.arange(length) - 10, 0)
    controls[:, :, lab.ids.arm_ctrl] += shaking.astype(np.float32)
    controls[:, :, lab.ids.arm_ctrl[1]] += lifting[:, None].astype(np.float32)
    return controls


@pytest.mark.parametrize(
    ("simulations", "devices", "cores", "threads"),
    [
        (64, 1, 8, 8),
        (64, 4, 8, 2),
        # What does not divide is rounded down: more threads than cores would wait for one another.
        (64, 3, 8, 2),
        (64, 8, 2, 1),
        (3, 1, 8, 3),
    ],
)
def test_local_devices_divide_the_cores(simulations, devices, cores, threads, monkeypatch):
    monkeypatch.setattr(jax, "local_device_count", lambda: devices)
    monkeypatch.setattr(native, "usable_cores", lambda: cores)
    assert native._num_threads(simulations) == threads


def test_a_scan_is_a_plain_loop_of_mujoco_to_the_bit(lab):
    model = lab.scene.mj_model
    qpos, _ = grasp_starts(lab)
    controls = grasping_controls(lab, 40)
    start = lab.init(qpos, controls[0])
    end, diverged = scan_of(lab.physics)(start, jnp.asarray(controls))
    assert not diverged.any()
    for row in (0, 3, NUM_ENVS - 1):
        data = mujoco.MjData(model)
        data.qpos[:] = qpos[row].astype(np.float32)
        touched = 0
        for ctrl in controls[:, row]:
            data.ctrl[:] = ctrl
            for _ in range(lab.physics.substeps):
                mujoco.mj_step(model, data)
            touched = max(touched, data.ncon)
        expected = np.zeros(mujoco.mj_stateSize(model, int(_CARRIED)))
        mujoco.mj_getState(model, data, expected, int(_CARRIED))
        np.testing.assert_array_equal(end.integration[row], expected.view(np.uint32))
        np.testing.assert_array_equal(end.qpos[row], data.qpos.astype(np.float32))
        np.testing.assert_array_equal(end.qvel[row], data.qvel.astype(np.float32))
        if row in range(NUM_ENVS)[HOLDING]:
            assert touched >= 6, "the table makes four contacts, and each finger one or more"


def test_the_callback_is_handed_memory_and_no_jax_arrays(lab, monkeypatch):
    seen = []

    def spy(pool, layout, rows, out, *, substeps):
        seen.append((type(rows), rows.shape, type(out), out.flags.writeable))
        out[...] = 0

    monkeypatch.setattr(native, "_step_rows", spy)
    # One substep more: compiled programs call the last function of a model and number of substeps.
    physics = make_native(lab.scene.mj_model, lab.physics.substeps + 1)
    qpos, ctrl = lab.home()
    jax.block_until_ready(jax.jit(jax.vmap(physics.step))(lab.init(qpos, ctrl), jnp.asarray(ctrl)))
    ((rows, shape, out, writeable),) = seen
    assert (rows, out, writeable) == (np.ndarray, np.ndarray, True)
    assert shape[0] == NUM_ENVS, "all environments in one call"


def test_one_environment_without_vmap(lab):
    qpos, ctrl = lab.home()
    expected = lab.step(lab.init(qpos, ctrl), ctrl)
    step = jax.jit(lab.physics.step)
    one = step(lab.physics.init(jnp.asarray(qpos[0]), jnp.asarray(ctrl[0])), jnp.asarray(ctrl[0]))
    np.testing.assert_array_equal(one.integration, expected.integration[0])
    assert one.diverged.shape == ()


def test_threads_do_not_mix(lab):
    qpos, _ = grasp_starts(lab)
    controls = grasping_controls(lab, 30)
    run = scan_of(lab.physics)
    inputs = [(lab.init(qpos, c[0]), jnp.asarray(c)) for c in (controls, controls[:, ::-1])]
    expected = [jax.block_until_ready(run(*args))[0] for args in inputs]
    results: dict[int, list] = {0: [], 1: []}
    gate = threading.Barrier(2)

    def work(which: int) -> None:
        gate.wait()
        for _ in range(5):
            results[which].append(jax.block_until_ready(run(*inputs[which]))[0])

    threads = [threading.Thread(target=work, args=(which,)) for which in results]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for which, states in results.items():
        assert len(states) == 5
        for state in states:
            np.testing.assert_array_equal(state.integration, expected[which].integration)
    assert (expected[0].integration != expected[1].integration).any()


def test_a_batch_is_lent_to_one_caller_at_a_time(scene):
    pool = BatchPool(scene.mj_model)
    with pool.borrow(4) as first, pool.borrow(4) as second, pool.borrow(2) as smaller:
        assert first is not second
        assert (first.nsim, smaller.nsim) == (4, 2)
    with pool.borrow(4) as again:
        assert again is first or again is second


TWO_DEVICES = """
    import jax, jax.numpy as jnp, numpy as np
    from jax.sharding import NamedSharding, PartitionSpec as P
    from mjx_arm.physics import make_physics
    from mjx_arm.envs.arm import resolve_arm
    from mjx_arm.scene import load_scene

    assert jax.device_count() == 2
    scene = load_scene("arm_cube")
    ids, physics = resolve_arm(scene), make_physics(scene.mj_model, "native", substeps=2)
    qpos = np.tile(ids.home_qpos, (8, 1))
    ctrl = np.tile(ids.home_ctrl, (8, 1))
    ctrl[:, ids.ctrl] += np.linspace(-0.3, 0.3, 8, dtype=np.float32)[:, None]

    def run(state, ctrl):
        step = lambda state, _: (jax.vmap(physics.step)(state, ctrl), None)
        return jax.lax.scan(step, state, None, length=50)[0]

    state, ctrl = jax.vmap(physics.init)(jnp.asarray(qpos), jnp.asarray(ctrl)), jnp.asarray(ctrl)
    expected = jax.jit(run)(state, ctrl)
    mesh = jax.make_mesh((2,), ("env",))
    split = NamedSharding(mesh, P("env"))
    sharded = jax.jit(jax.shard_map(run, mesh=mesh, in_specs=P("env"), out_specs=P("env")))
    actual = sharded(jax.device_put(state, split), jax.device_put(ctrl, split))
    np.testing.assert_array_equal(actual.integration, expected.integration)
    assert len(np.unique(np.asarray(expected.integration), axis=0)) == 8
    print("same")
"""


def test_two_devices_step_side_by_side(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=2")
    code = textwrap.dedent(TWO_DEVICES)
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.stdout.strip() == "same", done.stderr


def test_an_error_of_mujoco_ends_its_own_episode_only(in_empty_folder, capfd):
    model = mujoco.MjModel.from_xml_string(CRAMPED)
    physics = make_native(model, 2)
    qpos = np.zeros((3, model.nq), np.float32)
    qpos[:, 2:4] = 1.0
    qpos[1, 2] = 0.09
    step = jax.jit(jax.vmap(physics.step))
    start = jax.vmap(physics.init)(jnp.asarray(qpos), jnp.zeros((3, 0), jnp.float32))
    after = step(start, jnp.zeros((3, 0), jnp.float32))
    np.testing.assert_array_equal(after.diverged, [False, True, False])
    np.testing.assert_array_equal(after.qpos[1], qpos[1])
    np.testing.assert_array_equal(after.integration[0], after.integration[2])
    assert (after.qpos[0] != qpos[0]).any()
    assert capfd.readouterr() == ("", "")


def test_mujoco_may_log_again_afterwards(lab):
    before = mujoco.MjLogConfig.get()
    qpos, ctrl = lab.home()
    jax.block_until_ready(lab.step(lab.init(qpos, ctrl), ctrl))
    after = mujoco.MjLogConfig.get()
    assert (after.logto_file, after.logto_console) == (before.logto_file, before.logto_console)


MOCAP = '<body mocap="true"><geom size="1"/></body>'
DELAY = '<position joint="j" kp="1" delay="0.02" nsample="3"/>'
STATEFUL = """
<mujoco>
  {head}
  <worldbody><body><joint name="j"/><geom size="1"/></body>{world}</worldbody>
  <actuator>{servo}</actuator>
</mujoco>
"""


@pytest.mark.parametrize("backend", ["native", "mjx"])
@pytest.mark.parametrize(
    ("parts", "named"),
    [
        ({"world": MOCAP}, "mocap bodies"),
        ({"servo": DELAY}, "delays of actuators or sensors"),
        ({"head": '<option><flag sleep="enable"/></option>'}, "the flags 'sleep' or 'ipc'"),
        ({"head": '<size nuserdata="3"/>'}, "user data"),
    ],
)
def test_state_that_is_not_carried_is_rejected(backend, parts, named):
    text = STATEFUL.format(**{"head": "", "world": "", "servo": "", **parts})
    with pytest.raises(ValueError, match=f"physics supports no {named}.*: remove them from"):
        make_physics(mujoco.MjModel.from_xml_string(text), backend, substeps=1)


def test_plugins_are_rejected(scene):
    class WithPlugin:
        nplugin = 1
        nmocap = nhistory = nuserdata = 0
        opt = scene.mj_model.opt

    with pytest.raises(ValueError, match="physics supports no plugins"):
        check_model(WithPlugin)


def test_a_model_that_no_batch_can_run_is_rejected(scene, monkeypatch):
    def fail(*args, **kwargs):
        raise ValueError("no batch\nfor this")

    monkeypatch.setattr(native.mj_batch, "Batch", fail)
    with pytest.raises(ValueError, match=r"^physics 'native' cannot run this model: no batch for"):
        make_physics(scene.mj_model, "native", substeps=1)


@pytest.mark.parametrize("substeps", [2.9, 2.0, 0, -1, True, "2", None, np.nan])
@pytest.mark.parametrize("backend", ["native", "mjx"])
def test_substeps_that_are_no_count_are_rejected(scene, backend, substeps):
    with pytest.raises(ValueError, match="substeps must be a whole number of at least 1, got"):
        make_physics(scene.mj_model, backend, substeps=substeps)


def test_a_count_of_numpy_is_a_count(scene):
    physics = make_physics(scene.mj_model, "native", substeps=np.int64(2))
    assert type(physics.substeps) is int


def test_without_jit_the_steps_are_the_same(lab):
    qpos, ctrl = lab.home()
    expected = lab.run(lab.init(qpos, ctrl), ctrl, 2)
    with jax.disable_jit():
        state = jax.vmap(lab.physics.init)(jnp.asarray(qpos), jnp.asarray(ctrl))
        for _ in range(2):
            state = jax.vmap(lab.physics.step)(state, jnp.asarray(ctrl))
    np.testing.assert_array_equal(state.integration, expected.integration)


WITHOUT_JIT = """
    import threading
    import jax, jax.numpy as jnp
    from mjx_arm.physics import make_physics
    from mjx_arm.envs.arm import resolve_arm
    from mjx_arm.scene import load_scene

    scene = load_scene("arm_cube")
    ids = resolve_arm(scene)

    def work():
        physics = make_physics(scene.mj_model, "native", substeps=2)
        state = physics.init(jnp.asarray(ids.home_qpos), jnp.asarray(ids.home_ctrl))
        state = physics.step(state, jnp.asarray(ids.home_ctrl))
        print(bool(state.diverged), jax.config.jax_disable_jit)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
"""


def test_the_first_use_may_be_without_jit_and_in_a_thread(monkeypatch):
    monkeypatch.setenv("JAX_DISABLE_JIT", "1")
    code = textwrap.dedent(WITHOUT_JIT)
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.stdout.strip() == "False True", done.stderr


def test_poses_are_there_from_the_first_call(scene, ids):
    physics = make_native(scene.mj_model, 2)
    start = physics.init(ids.home_qpos, ids.home_ctrl)
    after = jax.jit(physics.step)(start, ids.home_ctrl)
    np.testing.assert_allclose(after.poses.geom_xpos, start.poses.geom_xpos, atol=0.01)
