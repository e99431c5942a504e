"""Throughput of the parts of a step: physics, rendering, and both in one scan.

    python benchmarks/throughput.py --json benchmarks/results/throughput.json

Each figure is the median of repeated runs after a warm-up, with the least and the most beside it.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from machine import machine

import mjx_arm


def measure(run: Callable[[Any], Any], argument: Any, work: int, repeats: int) -> dict[str, float]:
    """Rates of `work` units a call: median, least and most of the repeats, and compile time."""
    started = time.perf_counter()
    compiled = jax.jit(run).lower(argument).compile()
    compile_s = time.perf_counter() - started
    jax.block_until_ready(compiled(argument))
    rates = []
    for _ in range(repeats):
        started = time.perf_counter()
        jax.block_until_ready(compiled(argument))
        rates.append(work / (time.perf_counter() - started))
    return {
        "steps_per_s": round(statistics.median(rates)),
        "least": round(min(rates)),
        "most": round(max(rates)),
        "compile_s": round(compile_s, 2),
    }


def stages(env: mjx_arm.Env, num_envs: int, length: int) -> dict[str, Callable[[Any], Any]]:
    """The stages as functions of the environments' state."""
    auto = mjx_arm.AutoReset(env)
    keys = jax.random.split(jax.random.key(1), length)

    def step(state: Any, key: jax.Array) -> Any:
        action = jax.random.randint(key, (num_envs,), 0, env.num_actions)
        return jax.vmap(auto.transition)(jax.random.split(key, num_envs), state, action)[0]

    def draw(state: Any) -> jax.Array:
        return jax.vmap(env.observe)(state.env)

    def physics(state: Any) -> Any:
        return jax.lax.scan(lambda s, key: (step(s, key), None), state, keys)[0]

    def render(state: Any) -> Any:
        def once(state: Any, shift: jax.Array) -> tuple[Any, jax.Array]:
            # The poses depend on the step, or the image would be drawn once for all of them.
            physics = state.env.physics
            poses = physics.poses.replace(geom_xpos=physics.poses.geom_xpos + shift)
            moved = state.replace(env=state.env.replace(physics=physics.replace(poses=poses)))
            return state, draw(moved)[:, 0, 0]

        return jax.lax.scan(once, state, 1e-6 * jnp.arange(length, dtype=jnp.float32))

    def both(state: Any) -> Any:
        def once(carry: Any, key: jax.Array) -> tuple[Any, None]:
            state = step(carry[0], key)
            return (state, draw(state)), None

        return jax.lax.scan(once, (state, draw(state)), keys)[0]

    return {"physics": physics, "render": render, "physics+render": both}


def main() -> None:
    """Measures and prints a table; with `--json` writes the rows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer sizes and repeats")
    parser.add_argument("--json", type=pathlib.Path, help="file for the rows")
    parser.add_argument("--physics", default="auto", help="backend")
    options = parser.parse_args()
    sizes = (64,) if options.quick else (16, 64, 256, 1024)
    rows = []
    print(f"{'stage':<16}{'shadows':<9}{'envs':>6}{'per second':>12}{'least':>9}{'most':>9}")
    for shadows in (False, True):
        env = mjx_arm.make("B", physics=options.physics, observation="packed", shadows=shadows)
        for num_envs in sizes:
            length = max(4, 8192 // num_envs)
            reset = jax.jit(jax.vmap(mjx_arm.AutoReset(env).reset))
            state = reset(jax.random.split(jax.random.key(0), num_envs))[1]
            for stage, run in stages(env, num_envs, length).items():
                if shadows and stage == "physics":
                    continue
                row = {
                    "stage": stage,
                    "backend": env.physics.backend,
                    "substeps": env.physics.substeps,
                    "timestep": env.physics.timestep,
                    "size": list(env.config.size),
                    "shadows": shadows,
                    "num_envs": num_envs,
                    **measure(run, state, num_envs * length, 3 if options.quick else 7),
                }
                rows.append(row)
                print(
                    f"{stage:<16}{shadows!s:<9}{num_envs:>6}{row['steps_per_s']:>12,}"
                    f"{row['least']:>9,}{row['most']:>9,}",
                    flush=True,
                )
                if options.json:
                    options.json.parent.mkdir(parents=True, exist_ok=True)
                    report = {"machine": machine(), "rows": rows}
                    options.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
