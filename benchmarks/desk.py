"""What the desk scene, its textures, lights and shadows, and randomisation cost.

    python benchmarks/desk.py --json benchmarks/results/desk.json

In each round every variant renders, and steps and renders, the same number of frames, in an order
that alternates. A figure is the rate of a variant over that of the plain scene in the same round;
the table has the median of these ratios, the least and the most, and the plain scene's own rates.
`render` is the image alone, `step` one step of random actions with resets and the image.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import pathlib
import re
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from machine import machine

import mjx_arm
from mjx_arm.microbatch import microbatched, overwrite_microbatched
from mjx_arm.physics import compiler_options

PLAIN = "plain"
STAGES = ("render", "step")
XML = pathlib.Path(__file__).parents[1] / "xml"
# The desk scene without one of its parts -> what is cut out of its text.
_CUTS = {"untextured": r' texture="\w+"', "one_light": r'<light name="window"[^>]*/>'}


def variants(folder: pathlib.Path) -> dict[str, dict[str, Any]]:
    """Options of each variant; scenes that are made for this are written to `folder`."""
    text = (XML / "arm_cube_desk.xml").read_text()
    for image in XML.glob("desk_*.png"):
        (folder / image.name).write_bytes(image.read_bytes())
    for name, pattern in _CUTS.items():
        (folder / f"{name}.xml").write_text(re.sub(pattern, "", text))
    desk = {"scene": "arm_cube_desk"}
    moved = {"shadows": True, "camera_shift": 0.05}
    return {
        PLAIN: {},
        "plain, shadows": {"shadows": True},
        "plain, 4 samples": {"samples": 4},
        "plain, standard": {"randomisation": "standard"},
        "desk": desk,
        "desk, shadows": desk | {"shadows": True},
        "desk, shadows, camera": desk | moved,
        "the same without textures": {"scene": str(folder / "untextured.xml"), **moved},
        "the same with one light": {"scene": str(folder / "one_light.xml"), **moved},
        "desk, shadows, tight": desk | {"shadows": True, "randomisation": "tight"},
        "desk, shadows, standard": desk | {"shadows": True, "randomisation": "standard"},
    }


def stages(
    options: dict[str, Any], num_envs: int, length: int, wanted: Sequence[str]
) -> dict[str, Callable[[], Any]]:
    """Compiled functions that render, and that step and render, `num_envs * length` frames."""
    env = mjx_arm.make("B", physics="native", observation="packed", **options)
    auto, flags = mjx_arm.AutoReset(env), compiler_options(env.physics)
    keys = jax.random.split(jax.random.key(0), num_envs)
    state = jax.jit(jax.vmap(auto.reset), compiler_options=flags)(keys)[1]

    def observe(state: Any) -> jax.Array:
        return microbatched(jax.vmap(env.observe))(state.env)

    def render(state: Any) -> Any:
        def once(state: Any, shift: jax.Array) -> tuple[Any, jax.Array]:
            # The state depends on the step, or one image would be rendered for all of them.
            physics = state.env.physics
            poses = physics.poses.replace(geom_xpos=physics.poses.geom_xpos + shift)
            moved = physics.replace(poses=poses, qpos=physics.qpos + shift)
            image = observe(state.replace(env=state.env.replace(physics=moved)))
            return state, jnp.sum(image & 1, axis=(1, 2))

        return jax.lax.scan(once, state, 1e-6 * jnp.arange(length, dtype=jnp.float32))[1]

    def step(carry: Any) -> Any:
        def once(carry: Any, key: jax.Array) -> tuple[Any, None]:
            action = jax.random.randint(key, (num_envs,), 0, env.num_actions)
            each = jax.random.split(key, num_envs)
            state = jax.vmap(auto.transition)(each, carry[0], action)[0]
            return (state, overwrite_microbatched(jax.vmap(env.observe), state.env, carry[1])), None

        return jax.lax.scan(once, carry, jax.random.split(jax.random.key(1), length))[0]

    empty = jnp.zeros((num_envs, *env.config.size), jnp.uint32)
    made = {"render": (render, state), "step": (step, (state, empty))}
    made = {name: made[name] for name in wanted}
    return {
        name: functools.partial(jax.jit(run, compiler_options=flags).lower(x).compile(), x)
        for name, (run, x) in made.items()
    }


def time_once(run: Callable[[], Any]) -> float:
    """Seconds of one call."""
    started = time.perf_counter()
    jax.block_until_ready(run())
    return time.perf_counter() - started


def summarise(rounds: list[dict[str, dict[str, float]]]) -> list[dict[str, Any]]:
    """A row for each variant: rates, and ratios to the plain scene of the same round."""
    rows = []
    for name in rounds[0]:
        row: dict[str, Any] = {"variant": name}
        for stage in rounds[0][name]:
            ratios = [x[name][stage] / x[PLAIN][stage] for x in rounds]
            row[stage] = {
                "ratio": round(statistics.median(ratios), 3),
                "least": round(min(ratios), 3),
                "most": round(max(ratios), 3),
                "per_s": round(statistics.median(x[name][stage] for x in rounds)),
            }
        rows.append(row)
    return rows


def main() -> None:
    """Measures, prints a table and, where asked to, writes the file after each round."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--work", type=int, default=4096, help="frames of a timed call")
    parser.add_argument("--stages", nargs="+", default=STAGES, choices=STAGES)
    parser.add_argument("--only", nargs="+", help="variants beside the plain one; default all")
    parser.add_argument("--json", type=pathlib.Path, help="file for the results")
    options = parser.parse_args()
    length = max(1, options.work // options.num_envs)
    with tempfile.TemporaryDirectory() as folder:
        chosen = variants(pathlib.Path(folder))
        wanted = chosen if options.only is None else {PLAIN, *options.only}
        made = {
            name: stages(values, options.num_envs, length, options.stages)
            for name, values in chosen.items()
            if name in wanted
        }
    frames, rounds, loads = options.num_envs * length, [], []
    for run in (run for of in made.values() for run in of.values()):
        jax.block_until_ready(run())
    for i in range(options.rounds):
        order = list(made) if i % 2 == 0 else list(made)[::-1]
        now = {
            name: {stage: frames / time_once(run) for stage, run in made[name].items()}
            for name in order
        }
        rounds.append({name: now[name] for name in made})
        loads.append(round(os.getloadavg()[0], 2))
        table = summarise(rounds)
        if options.json:
            report = {"machine": machine(), "load": loads, "rounds": len(rounds), "rows": table}
            options.json.write_text(json.dumps(report, indent=1) + "\n")
    for row in table:
        for stage in options.stages:
            cell = row[stage]
            print(
                f"{row['variant']:<28}{stage:<8}{cell['ratio']:>7.3f} of plain, "
                f"{cell['least']:.3f} to {cell['most']:.3f}{cell['per_s']:>10,}/s"
            )


if __name__ == "__main__":
    main()
