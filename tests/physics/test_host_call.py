"""Functions that compiled programs call by name."""

from __future__ import annotations

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_arm.physics import host_call

pytestmark = pytest.mark.skipif(
    jax.default_backend() != "cpu", reason="only programs for the CPU call by name"
)

ROW = jax.ShapeDtypeStruct((3,), jnp.uint32)

ONCE = """
import sys
import jax
from mjx_arm.physics import make_physics
from mjx_arm.scene import load_scene, resolve_task
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
events = []
scene = load_scene("arm_cube")
ids, physics = resolve_task(scene), make_physics(scene, "native")
state = physics.init(jax.numpy.asarray(ids.home_qpos), jax.numpy.asarray(ids.home_ctrl))
jax.monitoring.register_event_listener(lambda name, **_: events.append(name))
end = jax.jit(physics.step)(state, jax.numpy.asarray(ids.home_ctrl))
hit = events.count("/jax/compilation_cache/cache_hits")
print(hit, float(end.poses.site_xpos.sum()))
"""


class TestCalls:
    """Of small functions."""

    def test_one_call_has_all_rows(self):
        shapes = []

        def double(operand, result):
            shapes.append(operand.shape)
            result[...] = 2 * operand

        host_call.register("test_double", double)
        rows = jnp.arange(24, dtype=jnp.uint32).reshape(2, 4, 3)
        run = jax.jit(jax.vmap(jax.vmap(lambda row: host_call.call("test_double", row, ROW))))
        np.testing.assert_array_equal(run(rows), 2 * rows)
        assert shapes == [(2, 4, 3)]

    def test_what_it_raises_reaches_the_caller(self):
        def fail(operand, result):
            raise ArithmeticError("the arm is off")

        host_call.register("test_fail", fail)
        run = jax.jit(lambda row: host_call.call("test_fail", row, ROW))
        with pytest.raises(Exception, match="the arm is off"):
            jax.block_until_ready(run(jnp.zeros(3, jnp.uint32)))

    def test_the_last_of_a_name_counts(self):
        run = jax.jit(lambda row: host_call.call("test_last", row, ROW))
        for value in (1, 2):
            host_call.register("test_last", lambda _, result, value=value: result.fill(value))
            np.testing.assert_array_equal(run(jnp.zeros(3, jnp.uint32)), value)


def test_a_second_process_finds_the_program_of_the_first(tmp_path):
    command = [sys.executable, "-c", ONCE, str(tmp_path)]
    done = [
        subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
        for _ in range(2)
    ]
    assert [hit for hit, _ in done] == ["0", "1"]
    assert done[0][1] == done[1][1]
