from __future__ import annotations

import copy
import importlib.util
import pathlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from physics_lab import scan_of

from mjx_arm.physics import make_physics
from mjx_arm.physics import mjx as mjx_backend
from mjx_arm.physics.mjx import make_mjx
from mjx_arm.scene import load_scene

WITHOUT_WARP = importlib.util.find_spec("warp") is None

MANY = """
import sys
import jax, jax.numpy as jnp, numpy as np
from mjx_arm.physics import make_physics
from mjx_arm.envs.arm import resolve_arm
from mjx_arm.scene import load_scene

envs = 256 * jax.device_count()
scene = load_scene("arm_cube")
ids = resolve_arm(scene)
physics = make_physics(scene.mj_model, "mjx", substeps=2, mjx_iterations=(5, 8))
qpos = jnp.asarray(np.tile(ids.home_qpos, (envs, 1)))
ctrl = jnp.asarray(np.tile(ids.home_ctrl, (envs, 1)))

def run(state, ctrl):
    step = lambda state, _: (jax.vmap(physics.step)(state, ctrl), None)
    return jax.lax.scan(step, state, None, length=50)[0]

state = jax.vmap(physics.init)(qpos, ctrl)
if jax.device_count() > 1:
    mesh = jax.make_mesh((jax.device_count(),), ("env",))
    spec = jax.sharding.PartitionSpec("env")
    state, ctrl = jax.device_put((state, ctrl), jax.NamedSharding(mesh, spec))
    run = jax.shard_map(run, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
print(bool(jnp.isfinite(jax.jit(run)(state, ctrl).qpos).all()))
"""


@pytest.mark.slow
@pytest.mark.parametrize("devices", [1, 2])
def test_many_environments_on_cpu_come_to_an_end(devices, monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    monkeypatch.setenv("XLA_FLAGS", f"--xla_force_host_platform_device_count={devices}")
    monkeypatch.setenv("NPROC", str(devices + 1))
    done = subprocess.run(
        [sys.executable, "-c", MANY], capture_output=True, text=True, timeout=900, check=False
    )
    assert done.stdout.strip() == "True", done.stderr


@pytest.fixture
def on_two_threads(monkeypatch):
    if jax.default_backend() != "cpu":
        pytest.skip("only XLA's CPU backend hangs")
    monkeypatch.setenv("NPROC", "2")


def test_a_program_that_may_hang_is_rejected(scene, on_two_threads):
    model = copy.copy(scene.mj_model)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    with pytest.raises(ValueError, match="start with NPROC=3 in the environment, or give"):
        make_mjx(model, 2)


def test_as_many_devices_as_threads_are_rejected(scene, on_two_threads, monkeypatch):
    monkeypatch.setattr(jax, "local_device_count", lambda: 2)
    with pytest.raises(ValueError, match="2 threads and 2 matrix factorisations at once"):
        make_physics(scene.mj_model, "mjx", substeps=2, mjx_iterations=(5, 8))


@pytest.mark.parametrize(("integrator", "threads"), [("IMPLICITFAST", "3"), ("EULER", "2")])
def test_enough_threads_are_not_rejected(scene, on_two_threads, monkeypatch, integrator, threads):
    monkeypatch.setenv("NPROC", threads)
    model = copy.copy(scene.mj_model)
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
    assert make_mjx(model, 2).backend == "mjx"


def test_importing_mjx_prints_nothing():
    code = "import mjx_arm.physics.mjx"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_products_keep_all_bits(scene, ids):
    """On a GPU jax would else take 10 bits of what is multiplied."""
    physics = make_physics(scene.mj_model, "mjx", substeps=2, mjx_iterations=(5, 8))
    state = physics.init(jnp.asarray(ids.home_qpos), jnp.asarray(ids.home_ctrl))
    program = jax.jit(physics.step).lower(state, jnp.asarray(ids.home_ctrl)).as_text()
    products = [line for line in program.splitlines() if "dot_general" in line]
    assert len(products) > 10
    assert all("HIGHEST, HIGHEST" in line for line in products)


@pytest.mark.parametrize(("given", "used"), [(None, (10, 20)), ((5, 8), (5, 8))])
def test_the_iterations_are_those_given_or_those_of_the_model(scene, monkeypatch, given, used):
    seen = []
    put_model = mjx_backend.mjx.put_model

    def spy(mj_model, **options):
        seen.append((mj_model.opt.iterations, mj_model.opt.ls_iterations))
        return put_model(mj_model, **options)

    monkeypatch.setattr(mjx_backend.mjx, "put_model", spy)
    make_physics(scene.mj_model, "mjx", substeps=1, mjx_iterations=given)
    assert seen == [used]
    assert (scene.mj_model.opt.iterations, scene.mj_model.opt.ls_iterations) == (10, 20)


def test_the_scene_says_how_often_mjx_iterates(scene, tmp_path):
    text = (pathlib.Path(__file__).parents[2] / "xml/arm_cube.xml").read_text()
    numeric = '<numeric name="mjx_iterations" data="8 8"/>'
    assert text.count(numeric) == 1
    assert scene.mjx_iterations == (8, 8)
    path = tmp_path / "scene.xml"
    path.write_text(text.replace(numeric, ""))
    assert load_scene(path).mjx_iterations == (10, 20)
    path.write_text(text.replace(numeric, numeric.replace("8 8", "5 0")))
    with pytest.raises(ValueError, match="'mjx_iterations' must hold whole numbers of at least 1"):
        load_scene(path).mjx_iterations  # noqa: B018


@pytest.mark.parametrize("iterations", [(5,), (5, 0), (5.5, 8), (True, 8)])
def test_iterations_that_are_no_counts_are_rejected(scene, iterations):
    with pytest.raises(ValueError, match="mjx_iterations must be"):
        make_physics(scene.mj_model, "mjx", substeps=2, mjx_iterations=iterations)


def model_with(option: str = "", geom: str = "", servo: str = "", body: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(f"""
        <mujoco>
          <option {option}><flag eulerdamp="disable"/></option>
          <worldbody>
            <geom name="wall" type="box" size="1 1 1" pos="0 0 -3"/>
            <body>
              <joint name="j" type="slide" axis="0 0 1"/>
              <geom size="0.1 0.1 0.1" {geom}/>
              {body}
            </body>
          </worldbody>
          <actuator><position joint="j" kp="10" {servo}/></actuator>
        </mujoco>
    """)


@pytest.mark.parametrize(
    ("parts", "named"),
    [
        ({"option": 'integrator="implicit"'}, "integrator implicit"),
        ({"option": 'solver="PGS"'}, "solver pgs"),
        ({"option": 'noslip_iterations="3"'}, "noslip_iterations"),
        ({"geom": 'type="cylinder"'}, r"\(geom cylinder, geom box\) collisions"),
        ({"geom": 'surfacevel="1 0 0 0 0 0"'}, "geom_surfacevel"),
        ({"geom": 'adhesion="2"'}, "geom_adhesion"),
        ({"servo": 'armature="3"'}, "actuator_armature"),
        ({"servo": 'damping="3"'}, "actuator_damping"),
        ({"option": 'cone="elliptic"', "geom": 'condim="1"'}, "condim=1 with ConeType.ELLIPTIC"),
    ],
)
def test_what_mjx_does_not_implement_is_named(parts, named):
    model = model_with(**parts)
    if "condim" in parts.get("geom", ""):
        model.geom_condim[:] = 1
    message = f"^physics 'mjx' does not implement {named}: change the model, or give physics='na"
    with pytest.raises(ValueError, match=message) as caught:
        make_physics(model, "mjx", substeps=1)
    assert "\n" not in str(caught.value)
    assert make_physics(model, "native", substeps=1).backend == "native"


def test_the_model_without_these_parts_is_not_rejected():
    assert make_physics(model_with(), "mjx", substeps=1).backend == "mjx"


@pytest.mark.skipif(not WITHOUT_WARP, reason="the extra 'warp' is installed")
def test_mjx_warp_without_its_extra_is_rejected(scene):
    with pytest.raises(ValueError, match=r"needs the extra 'warp': pip install 'mjx-arm\[warp\]'"):
        make_physics(scene.mj_model, "mjx-warp", substeps=2)


@pytest.mark.skipif(WITHOUT_WARP, reason="needs the extra 'warp': pip install 'mjx-arm[warp]'")
def test_mjx_warp_goes_where_native_goes(scene, ids):
    qpos = jnp.asarray(np.tile(ids.home_qpos, (4, 1)))
    ctrl = np.tile(ids.home_ctrl, (4, 1))
    ctrl[:, ids.arm_ctrl] += np.float32(0.1)
    ends = []
    for backend in ("native", "mjx-warp"):
        physics = make_physics(scene.mj_model, backend, substeps=2)
        start = jax.vmap(physics.init)(qpos, jnp.asarray(ctrl))
        ends.append(scan_of(physics)(start, jnp.asarray(np.tile(ctrl, (20, 1, 1))))[0])
    native, warp = ends
    assert not warp.diverged.any()
    np.testing.assert_allclose(warp.qpos, native.qpos, atol=1e-3)
