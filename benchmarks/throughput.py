"""Throughput of each stage of training, alone and together, over numbers of environments.

    python benchmarks/throughput.py --json benchmarks/results/throughput.json

Stages: `physics`, `render`, `physics+render`, `act` (the network on one observation of every
environment), `learn` (one update: sampling, drawing and the gradient step) and `train` (the whole
loop). Each figure is the median of repeated chunks after a warm-up, with the least and the most
beside it. With `--json` a log-log plot is written next to the file.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import pathlib
import resource
import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from machine import machine
from matplotlib.figure import Figure

import mjx_arm
from mjx_arm.loop import make_body, make_trainer
from mjx_arm.memory import memory_plan
from mjx_arm.physics import compiler_options

STAGES = ("physics", "render", "physics+render", "act", "learn", "train")
NUM_ENVS = (16, 64, 256, 1024, 4096, 16384)
# Environment steps, frames or decisions of one timed chunk.
_WORK = 8192
_UPDATES = 8


def time_chunks(
    run: Callable[[Any], Any], state: Any, work: int, repeats: int, options: Any, donate: bool
) -> dict[str, float]:
    """Rates of `work` units a call: median, least and most of the repeats, and compile time."""
    started = time.perf_counter()
    jitted = jax.jit(run, donate_argnums=0 if donate else (), compiler_options=options)
    compiled = jitted.lower(state).compile()
    compile_s = time.perf_counter() - started
    # Donated, the state of one chunk is the next one's.
    result = jax.block_until_ready(compiled(state))
    rates = []
    for _ in range(repeats):
        started = time.perf_counter()
        result = jax.block_until_ready(compiled(result if donate else state))
        rates.append(work / (time.perf_counter() - started))
    return {
        "steps_per_s": round(statistics.median(rates)),
        "least": round(min(rates)),
        "most": round(max(rates)),
        "compile_s": round(compile_s, 2),
    }


def env_stages(env: mjx_arm.Env, num_envs: int, length: int) -> dict[str, Callable[[Any], Any]]:
    """The stages of the environment, as functions of the environments' state."""
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


def agent_stages(config: mjx_arm.TrainConfig, length: int) -> dict[str, Callable[[Any], Any]]:
    """The stages of the agent, as functions of the loop's state."""
    body = make_body(config)

    def act(state: Any) -> Any:
        def once(obs: jax.Array, _: None) -> tuple[jax.Array, None]:
            q = body.dqn.apply(state.learner.params, obs)
            # Depends on the result, or the network would be applied once.
            return obs ^ (q[:, :1, None] > 1e9).astype(jnp.uint32), None

        return jax.lax.scan(once, state.obs, None, length=length)[0]

    def learn(state: Any) -> Any:
        # The ring as if it were full: what is in it does not matter.
        full = dataclasses.replace(state.replay, count=jnp.int32(config.replay_slots))

        def once(learner: Any, key: jax.Array) -> tuple[Any, None]:
            return body.learn(key, learner, full)[0], None

        keys = jax.random.split(jax.random.key(2), _UPDATES)
        return jax.lax.scan(once, state.learner, keys)[0]

    return {"act": act, "learn": learn}


def rows(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Measures; a row a figure."""
    repeats = 3 if options.quick else 7
    for shadows in options.shadows:
        for size in options.sizes:
            for num_envs in options.num_envs:
                length = max(2 if options.quick else 4, _WORK // num_envs)
                common = {"size": size, "shadows": shadows, "num_envs": num_envs}
                yield from env_rows(options, common, length, repeats)
                if not shadows:
                    yield from agent_rows(options, common, length, repeats)


def env_rows(
    options: argparse.Namespace, common: dict[str, Any], length: int, repeats: int
) -> Iterator[dict[str, Any]]:
    """Rows of the stages of the environment."""
    size, shadows, num_envs = common["size"], common["shadows"], common["num_envs"]
    env = mjx_arm.make(
        "B", physics=options.physics, observation="packed", size=(size, size), shadows=shadows
    )
    flags = compiler_options(env.physics)
    state = jax.jit(jax.vmap(mjx_arm.AutoReset(env).reset), compiler_options=flags)(
        jax.random.split(jax.random.key(0), num_envs)
    )[1]
    for stage, run in env_stages(env, num_envs, length).items():
        if stage in options.stages and not (shadows and stage == "physics"):
            figures = time_chunks(run, state, num_envs * length, repeats, flags, donate=False)
            yield {"stage": stage, **describe(env), **common, **figures}


def agent_rows(
    options: argparse.Namespace, common: dict[str, Any], length: int, repeats: int
) -> Iterator[dict[str, Any]]:
    """Rows of the stages of the agent, for both storages where that matters."""
    size, num_envs = common["size"], common["num_envs"]
    for storage in options.storages:
        config = mjx_arm.TrainConfig(
            env="B",
            physics=options.physics,
            size=(size, size),
            num_envs=num_envs,
            storage=storage,
            # Enough for the longest chunk; pixels of more would not fit everywhere.
            replay_size=max(20_000, 8 * num_envs) if storage == "pixels" else 200_000,
            learning_starts=0,
            chunk_steps=num_envs * length,
        )
        # One update for each 64 steps, the default's ratio of samples to steps.
        config = dataclasses.replace(config, updates_per_step=max(1, num_envs // 64))
        trainer = make_trainer(config)
        flags = compiler_options(trainer.env.physics)
        state = trainer.init(jax.random.key(0))
        plan = sum(memory_plan(state).values())
        named = {**describe(trainer.env), **common, "storage": storage, "planned_bytes": plan}
        for stage, run in agent_stages(config, length).items():
            if stage in options.stages and (stage == "learn" or storage == "states"):
                work = _UPDATES if stage == "learn" else num_envs * length
                figures = time_chunks(run, state, work, repeats, flags, donate=False)
                yield {"stage": stage, "batch_size": config.batch_size, **named, **figures}
        if "train" in options.stages:
            # Twice, for the replay must fill before the first update.
            run = make_body(config).run_chunk
            figures = time_chunks(
                lambda state, run=run: run(state)[0],
                state,
                num_envs * length,
                repeats,
                flags,
                donate=True,
            )
            ratio = config.updates_per_step * config.batch_size / num_envs
            yield {"stage": "train", "samples_per_step": ratio, **named, **figures}


def describe(env: mjx_arm.Env) -> dict[str, Any]:
    """What a row says of its environment."""
    physics = env.physics
    return {
        "backend": physics.backend,
        "substeps": physics.substeps,
        "timestep": physics.timestep,
    }


def plot(rows: list[dict[str, Any]], path: pathlib.Path) -> None:
    """Log-log plot of the figures of 64 by 64 pixels without shadows."""
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    chosen = [row for row in rows if row["size"] == 64 and not row["shadows"]]
    for stage in STAGES:
        own = [r for r in chosen if r["stage"] == stage and r.get("storage", "states") == "states"]
        if stage != "learn" and own:
            x, y = ([row[name] for row in own] for name in ("num_envs", "steps_per_s"))
            low, high = (np.asarray([row[name] for row in own]) for name in ("least", "most"))
            spread = [np.asarray(y) - low, high - np.asarray(y)]
            axes.errorbar(x, y, spread, marker="o", markersize=4, capsize=2, label=stage)
    axes.set(xscale="log", yscale="log", xlabel="environments", ylabel="steps or frames per second")
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    figure.savefig(path, dpi=110)


def parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="within 2 minutes on two cores")
    parser.add_argument("--json", type=pathlib.Path, help="file for the rows")
    parser.add_argument("--physics", default="auto", help="backend")
    parser.add_argument("--stages", nargs="+", choices=STAGES, default=STAGES)
    parser.add_argument("--num-envs", nargs="+", type=int)
    parser.add_argument("--sizes", nargs="+", type=int, default=[64], help="edges, pixels")
    parser.add_argument("--storages", nargs="+", choices=("states", "pixels"))
    parser.add_argument("--shadows", nargs="+", type=int, choices=(0, 1))
    options = parser.parse_args()
    quick = options.quick
    options.num_envs = options.num_envs or ([64] if quick else list(NUM_ENVS))
    options.storages = options.storages or (["states"] if quick else ["states", "pixels"])
    options.shadows = [bool(x) for x in options.shadows or ([0] if quick else [0, 1])]
    return options


def main() -> None:
    """Measures and prints a table; with `--json` writes the rows and a plot."""
    options, done = parse(), []
    print(f"{'stage':<16}{'storage':<9}{'shadows':<9}{'envs':>6}{'per second':>12}", end="")
    print(f"{'least':>9}{'most':>9}{'compile s':>11}")
    for row in rows(options):
        done.append(row)
        print(
            f"{row['stage']:<16}{row.get('storage', ''):<9}{row['shadows']!s:<9}"
            f"{row['num_envs']:>6}{row['steps_per_s']:>12,}{row['least']:>9,}{row['most']:>9,}"
            f"{row['compile_s']:>11}",
            flush=True,
        )
        if options.json:
            options.json.parent.mkdir(parents=True, exist_ok=True)
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
            report = {"machine": machine(), "peak_resident_bytes": peak, "rows": done}
            options.json.write_text(json.dumps(report, indent=1) + "\n")
            plot(done, options.json.with_suffix(".png"))


if __name__ == "__main__":
    main()
