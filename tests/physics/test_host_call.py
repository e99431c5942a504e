"""Functions that compiled programs call by name."""

from __future__ import annotations

import ctypes
import functools
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_arm.physics import host_call, make_physics

pytestmark = pytest.mark.skipif(
    jax.default_backend() != "cpu", reason="only programs for the CPU call by name"
)

ROW = jax.ShapeDtypeStruct((3,), jnp.uint32)

ONCE = """
import sys
import jax
from mjx_arm.physics import make_physics
from mjx_arm.envs.arm import resolve_arm
from mjx_arm.scene import load_scene
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
events = []
scene = load_scene("arm_cube")
ids, physics = resolve_arm(scene), make_physics(scene.mj_model, "native", substeps=2)
state = physics.init(jax.numpy.asarray(ids.home_qpos), jax.numpy.asarray(ids.home_ctrl))
jax.monitoring.register_event_listener(lambda name, **_: events.append(name))
end = jax.jit(physics.step)(state, jax.numpy.asarray(ids.home_ctrl))
hit = events.count("/jax/compilation_cache/cache_hits")
print(hit, float(end.poses.site_xpos.sum()))
"""

LEAVES = """
import sys
import jax
import mjx_arm
env = mjx_arm.make("A", observation="state", physics="native")
_, state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 64))
def move(state, _):
    return jax.vmap(env.transition, (0, None))(state, 3)[0], None
run = jax.jit(lambda state: jax.lax.scan(move, state, None, length=1000)[0])
run = run.lower(state).compile()
end = run(state)
if sys.argv[1] == "forgotten":
    del end
print("left")
"""


def _nothing(operand, result):
    raise AssertionError("the name should count")


class TestCalls:
    """Of small functions."""

    def test_one_call_has_all_rows(self):
        shapes = []

        def double(operand, result):
            shapes.append(operand.shape)
            result[...] = 2 * operand

        host_call.register("test_double", double)
        rows = jnp.arange(24, dtype=jnp.uint32).reshape(2, 4, 3)
        one = functools.partial(host_call.call, "test_double", double, result=ROW)
        run = jax.jit(jax.vmap(jax.vmap(one)))
        np.testing.assert_array_equal(run(rows), 2 * rows)
        assert shapes == [(2, 4, 3)]

    def test_what_it_raises_reaches_the_caller(self):
        def fail(operand, result):
            raise ArithmeticError("the arm is off")

        host_call.register("test_fail", fail)
        run = jax.jit(lambda row: host_call.call("test_fail", fail, row, ROW))
        with pytest.raises(Exception, match="the arm is off"):
            jax.block_until_ready(run(jnp.zeros(3, jnp.uint32)))

    def test_the_last_of_a_name_counts(self):
        run = jax.jit(lambda row: host_call.call("test_last", _nothing, row, ROW))
        for value in (1, 2):
            host_call.register("test_last", lambda _, result, value=value: result.fill(value))
            np.testing.assert_array_equal(run(jnp.zeros(3, jnp.uint32)), value)


@pytest.fixture
def fresh_verdict():
    """The verdict on XLA's structs is found anew, in the test and after it."""
    handlers = dict(host_call._handlers)
    host_call.usable.cache_clear()
    yield
    host_call._handlers.clear()
    host_call._handlers.update(handlers)
    host_call.usable.cache_clear()


@pytest.mark.parametrize("name", ["_Frame", "_Buffers", "_Buffer"])
def test_structs_of_another_size_are_not_used(name, monkeypatch, fresh_verdict):
    """XLA's calls are judged by structs that are longer than its own."""
    size = ctypes.sizeof(getattr(host_call, name))
    wrong = 4096 if name == "_Frame" else size + 8
    other = type(name, (ctypes.Structure,), {"_fields_": (("bytes", ctypes.c_byte * wrong),)})
    monkeypatch.setattr(host_call, name, other)
    monkeypatch.setattr(host_call, "_PROBE", f"mjx_arm_probe_{name}")
    assert not host_call.usable()


@pytest.mark.parametrize("name", ["_MetadataExtension", "_Version"])
def test_metadata_of_another_size_is_not_used(name, monkeypatch, fresh_verdict):
    size = ctypes.sizeof(getattr(host_call, name))
    measured = ctypes.sizeof

    def sizeof(struct):
        return measured(struct) + 8 if struct is getattr(host_call, name) else measured(struct)

    assert sizeof(getattr(host_call, name)) == size + 8
    monkeypatch.setattr(host_call.ctypes, "sizeof", sizeof)
    monkeypatch.setattr(host_call, "_PROBE", f"mjx_arm_probe_{name}")
    assert not host_call.usable()


def test_the_structs_of_this_xla_are_used():
    assert host_call.usable()


def test_without_the_structs_physics_is_the_same(scene, ids, monkeypatch):
    ends = []
    for usable in (True, False):
        monkeypatch.setattr(host_call, "usable", lambda usable=usable: usable)
        physics = make_physics(scene.mj_model, "native", substeps=2)
        qpos = jnp.asarray(np.tile(ids.home_qpos, (4, 1)))
        ctrl = jnp.asarray(np.tile(ids.home_ctrl, (4, 1))) + jnp.arange(4.0)[:, None] / 100
        step = jax.jit(jax.vmap(physics.step))
        state = step(jax.vmap(physics.init)(qpos, ctrl), ctrl)
        program = step.lower(state, ctrl).as_text()
        assert ("mjx_arm_step" in program) == usable
        ends.append(step(state, ctrl))
    for one, other in zip(*map(jax.tree.leaves, ends), strict=True):
        np.testing.assert_array_equal(one, other)


def test_without_the_structs_what_it_raises_reaches_the_caller(monkeypatch):
    monkeypatch.setattr(host_call, "usable", lambda: False)

    def fail(operand, result):
        raise ArithmeticError("the arm is off")

    run = jax.jit(lambda row: host_call.call("test_fail_alone", fail, row, ROW))
    with pytest.raises(Exception, match="the arm is off"):
        jax.block_until_ready(run(jnp.zeros(3, jnp.uint32)))


def test_a_second_process_finds_the_program_of_the_first(tmp_path):
    command = [sys.executable, "-c", ONCE, str(tmp_path)]
    done = [
        subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
        for _ in range(2)
    ]
    assert [hit for hit, _ in done] == ["0", "1"]
    assert done[0][1] == done[1][1]


@pytest.mark.parametrize("result", ["kept", "forgotten"])
def test_a_process_that_ends_while_a_program_runs_ends_well(result):
    done = subprocess.run(
        [sys.executable, "-c", LEAVES, result], capture_output=True, text=True, timeout=120
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "left\n", "")
