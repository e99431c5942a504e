"""What the native backend costs over a plain Python loop around `mujoco.batch`.

Both do the same iterations of the same scene from the same state under the same controls. The loop
steps a `Batch`, has it compute the position stage, and copies state, poses and warnings out; the
backend runs in a `lax.scan`. They take turns, so that a busy machine slows both.

    python benchmarks/native_overhead.py --json benchmarks/results/native_overhead.json
"""

from __future__ import annotations

import argparse
import json
import pathlib
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from machine import machine
from mujoco import batch as mj_batch

from mjx_arm.cores import usable_cores
from mjx_arm.envs.arm import resolve_arm
from mjx_arm.physics import Physics, make_physics
from mjx_arm.scene import Scene, load_scene

BATCH_SIZES = (16, 32, 64, 128, 256, 512, 1024)
# Environment iterations of one measurement: a tenth of a second or so on two cores.
_ITERATIONS = 8192


def make_backend(physics: Physics, scene: Scene, num_envs: int, length: int) -> Callable[[], None]:
    """Returns a function that runs `length` iterations of the backend in one scan."""
    arm = resolve_arm(scene)
    qpos = jnp.asarray(np.tile(arm.home_qpos, (num_envs, 1)))
    ctrl = jnp.asarray(np.tile(arm.home_ctrl, (num_envs, 1)))
    start = jax.vmap(physics.init)(qpos, ctrl)

    @jax.jit
    def run(state, ctrl):
        def body(state, _):
            return jax.vmap(physics.step)(state, ctrl), None

        return jax.lax.scan(body, state, None, length=length)[0]

    return lambda: jax.block_until_ready(run(start, ctrl))


def make_loop(physics: Physics, scene: Scene, num_envs: int, length: int) -> Callable[[], None]:
    """Returns a function that runs `length` iterations of the plain loop."""
    arm = resolve_arm(scene)
    batch = mj_batch.Batch(scene.mj_model, num_envs, nthread=min(num_envs, usable_cores()))
    batch.reset()
    ctrl = np.tile(arm.home_ctrl, (num_envs, 1))
    derived = [batch.bind(name) for name in ("geom_xpos", "geom_xmat", "site_xpos")]

    def run() -> None:
        batch.bind("qpos")[:] = arm.home_qpos
        batch.bind("qvel")[:] = 0.0
        for _ in range(length):
            batch.ctrl[:] = ctrl
            batch.step(nstep=physics.substeps, stage=mujoco.mjtStage.mjSTAGE_POS)
            batch.state.copy()
            batch.warning.copy()
            for field in derived:
                field.astype(np.float32)

    return run


def measure(functions: dict[str, Callable[[], None]], repeats: int) -> dict[str, list[float]]:
    """Seconds of each function, run in turns after one run that does not count."""
    seconds: dict[str, list[float]] = {name: [] for name in functions}
    for function in functions.values():
        function()
    for _ in range(repeats):
        for name, function in functions.items():
            begin = time.perf_counter()
            function()
            seconds[name].append(time.perf_counter() - begin)
    return seconds


def main() -> None:
    """Measures, prints a table and, where asked to, writes the figures to a file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batch-sizes", type=int, nargs="+", default=BATCH_SIZES)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--json", type=pathlib.Path, help="write the figures to this file")
    args = parser.parse_args()

    scene = load_scene("arm_cube")
    physics = make_physics(scene.mj_model, "native", substeps=scene.substeps)
    rows = []
    print(f"iterations/s of {physics.substeps} substeps: best of {args.repeats}, and median")
    print("   envs          native            loop   native/loop")
    for num_envs in args.batch_sizes:
        length = max(1, _ITERATIONS // num_envs)
        functions = {
            "native": make_backend(physics, scene, num_envs, length),
            "loop": make_loop(physics, scene, num_envs, length),
        }
        seconds = measure(functions, args.repeats)
        rate = {name: num_envs * length / np.asarray(times) for name, times in seconds.items()}
        best = {name: float(values.max()) for name, values in rate.items()}
        median = {name: float(np.median(values)) for name, values in rate.items()}
        ratios = best["native"] / best["loop"], median["native"] / median["loop"]
        rows.append({"num_envs": num_envs, "best": best, "median": median})
        print(
            f"{num_envs:7d}"
            + "".join(f"{best[name]:9.0f}{median[name]:7.0f}" for name in functions)
            + f"{ratios[0]:9.2f}{ratios[1]:6.2f}"
        )
    if args.json:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        report = {"machine": machine(), "substeps": physics.substeps, "rows": rows}
        args.json.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
