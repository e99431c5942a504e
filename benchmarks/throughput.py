"""Throughput of each stage of training, alone and together, over numbers of environments.

    python benchmarks/throughput.py --json benchmarks/results/throughput.json
    python benchmarks/throughput.py --gpu --json benchmarks/results/gpu.json

Stages: `physics`, `render`, `physics+render`, `act` (the network on one observation of every
environment), `learn` (one update: sampling, rendering and the gradient step) and `train` (the whole
loop). Each figure is the median of repeated chunks after a warm-up, and with `--rounds` of those
medians, with the least and the most of all chunks beside it; memory is that of a run, at its peak,
beside the plan that it prints. With `--json` rows are written as they come, and a log-log plot next
to the file.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import ctypes
import dataclasses
import functools
import gc
import importlib.util
import itertools
import json
import multiprocessing
import pathlib
import statistics
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from machine import machine

import mjx_arm
from mjx_arm.config import set_train_options
from mjx_arm.microbatch import microbatched, overwrite_microbatched
from mjx_arm.physics import BACKENDS, compiler_options
from mjx_arm.training.loop import make_body, make_trainer
from mjx_arm.training.memory import memory_plan, working_memory

_ENV_STAGES = ("physics", "render", "physics+render")
STAGES = (*_ENV_STAGES, "act", "learn", "train")
# What the other stages add up to.
_SUMS = ("physics+render", "train")
NUM_ENVS = (16, 64, 256, 1024, 4096, 16384)
# Updates of one timed chunk, at least.
_UPDATES = 8


def time_chunks(run: Callable[[], Any], work: int, repeats: int) -> dict[str, int]:
    """Rates of `work` units a call after one that does not count: median, least and most."""
    jax.block_until_ready(run())
    rates = []
    for _ in range(repeats):
        started = time.perf_counter()
        jax.block_until_ready(run())
        rates.append(work / (time.perf_counter() - started))
    middle, least, most = statistics.median(rates), min(rates), max(rates)
    return {"steps_per_s": round(middle), "least": round(least), "most": round(most)}


def time_stage(
    run: Callable[[Any], Any], state: Any, work: int, repeats: int, options: Any
) -> dict[str, float]:
    """Rates and compile time of a stage that leaves its state as it is."""
    started = time.perf_counter()
    compiled = jax.jit(run, compiler_options=options).lower(state).compile()
    compile_s = round(time.perf_counter() - started, 2)
    return time_chunks(lambda: compiled(state), work, repeats) | {"compile_s": compile_s}


@dataclasses.dataclass(frozen=True)
class Training:
    """A training run that is compiled, and what is known of it by then."""

    config: mjx_arm.TrainConfig
    init: jax.stages.Compiled
    run_chunk: jax.stages.Compiled
    compile_s: float
    planned_bytes: int


def compile_training(config: mjx_arm.TrainConfig) -> Training:
    """Compiles what a training run calls."""
    trainer = make_trainer(config)
    key = jax.random.key(0)
    shapes = jax.eval_shape(trainer.init, key)
    init = trainer.init.lower(key).compile()
    started = time.perf_counter()
    run = trainer.run_chunk.lower(shapes).compile()
    compile_s = round(time.perf_counter() - started, 2)
    working = working_memory(run, trainer.env.physics, config.num_envs)
    planned = sum(memory_plan(shapes).values()) + working
    return Training(config, init, run, compile_s, planned)


def peak_memory(training: Training) -> dict[str, int]:
    """Bytes that training comes to hold beyond what the process held once it was compiled.

    Looked at every millisecond: of the device's memory what is in use, on CPU of the heap. The
    device's own count of the most would not do, since trying out kernels may have taken more.
    """
    gc.collect()

    def train() -> None:
        state = training.init(jax.random.key(0))
        for _ in range(2):
            state, counts = training.run_chunk(state)
            jax.device_get(counts)
            # Training writes its metrics; at once the next would get its room before the last one's
            # is given back, a moment after the result.
            time.sleep(0.05)

    peak = growth(train, device_in_use() or heap_in_use())
    return {} if peak is None else {"peak_bytes": peak}


def device_in_use() -> Callable[[], int] | None:
    """A function that returns the bytes in use on the device, where it counts them."""
    device = jax.devices()[0]
    # Also None where the device counts nothing.
    if "bytes_in_use" not in (device.memory_stats() or {}):
        return None
    return lambda: device.memory_stats()["bytes_in_use"]


class _Mallinfo2(ctypes.Structure):
    """glibc's account of its heap; see mallinfo(3)."""

    # Ten counts, of which two matter: in blocks of their own, and in blocks of the arenas.
    _fields_ = (
        ("before", ctypes.c_size_t * 4),
        ("hblkhd", ctypes.c_size_t),
        ("between", ctypes.c_size_t * 2),
        ("uordblks", ctypes.c_size_t),
        ("after", ctypes.c_size_t * 2),
    )


def heap_in_use() -> Callable[[], int] | None:
    """A function that returns the bytes of the heap in use; glibc only.

    The resident set would not do: a heap keeps pages of what was freed, and hands them out again.
    """
    mallinfo2 = getattr(ctypes.CDLL(None), "mallinfo2", None)
    if mallinfo2 is None:
        return None
    mallinfo2.restype = _Mallinfo2

    def in_use() -> int:
        now = mallinfo2()
        return now.uordblks + now.hblkhd

    return in_use


def growth(run: Callable[[], Any], in_use: Callable[[], int] | None) -> int | None:
    """How much more is in use at the most while `run` works than before."""
    if in_use is None:
        run()
        return None
    done = threading.Event()
    seen = [in_use()]

    def keep_looking() -> None:
        while not done.wait(0.001):
            seen.append(in_use())

    watcher = threading.Thread(target=keep_looking)
    watcher.start()
    try:
        run()
    finally:
        done.set()
        watcher.join()
    return max(seen) - seen[0]


def peak_memory_apart(config: mjx_arm.TrainConfig) -> dict[str, int]:
    """The same in a process of its own, whose heap nothing else uses."""
    spawn = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(1, mp_context=spawn) as pool:
        return pool.submit(_compiled_peak_memory, config).result()


def _compiled_peak_memory(config: mjx_arm.TrainConfig) -> dict[str, int]:
    return peak_memory(compile_training(config))


def env_stages(env: mjx_arm.Env, num_envs: int, length: int) -> dict[str, Callable[[Any], Any]]:
    """The stages of the environment, as functions of the environments' state and their images."""
    auto = mjx_arm.AutoReset(env)
    keys = jax.random.split(jax.random.key(1), length)

    def step(state: Any, key: jax.Array) -> Any:
        action = jax.random.randint(key, (num_envs,), 0, env.num_actions)
        return jax.vmap(auto.transition)(jax.random.split(key, num_envs), state, action)[0]

    def physics(carry: Any) -> Any:
        return jax.lax.scan(lambda s, key: (step(s, key), None), carry[0], keys)[0]

    def render(carry: Any) -> Any:
        def once(state: Any, shift: jax.Array) -> tuple[Any, jax.Array]:
            # The poses depend on the step, or one image would be rendered for all of them.
            physics = state.env.physics
            poses = physics.poses.replace(geom_xpos=physics.poses.geom_xpos + shift)
            moved = state.replace(env=state.env.replace(physics=physics.replace(poses=poses)))
            # All pixels count, or a GPU would render only those that do.
            return state, jnp.sum(draw(env, moved) & 1, axis=(1, 2))

        return jax.lax.scan(once, carry[0], 1e-6 * jnp.arange(length, dtype=jnp.float32))

    def both(carry: Any) -> Any:
        def once(carry: Any, key: jax.Array) -> tuple[Any, None]:
            state = step(carry[0], key)
            return (state, overwrite_microbatched(jax.vmap(env.observe), state.env, carry[1])), None

        return jax.lax.scan(once, carry, keys)[0]

    return {"physics": physics, "render": render, "physics+render": both}


def draw(env: mjx_arm.Env, state: Any) -> jax.Array:
    """Images of all environments."""
    return microbatched(jax.vmap(env.observe))(state.env)


def agent_stages(config: mjx_arm.TrainConfig, length: int) -> dict[str, Callable[[Any], Any]]:
    """The stages of the agent, as functions of the loop's state."""
    body = make_body(config)

    def act(state: Any) -> Any:
        def once(obs: jax.Array, _: None) -> tuple[jax.Array, None]:
            q = body.algorithm.apply(state.learner.params, obs)
            # Depends on the result, or the network would be applied once.
            return obs ^ (q[:, :1, None] > 1e9).astype(jnp.uint32), None

        return jax.lax.scan(once, state.obs, None, length=length)[0]

    def learn(state: Any) -> Any:
        # The ring as if it were full: what is in it does not matter.
        full = dataclasses.replace(state.replay, count=jnp.int32(config.replay_slots))
        steps = jnp.int32(config.replay.replay_size)

        def once(learner: Any, key: jax.Array) -> tuple[Any, None]:
            return body.algorithm.learn(key, learner, full, steps)[0], None

        keys = jax.random.split(jax.random.key(2), _learn_calls(config))
        return jax.lax.scan(once, state.learner, keys)[0]

    return {"act": act, "learn": learn}


def _learn_calls(config: mjx_arm.TrainConfig) -> int:
    """Steps of learning in a timed chunk; each has `updates_per_step` updates."""
    return max(1, _UPDATES // config.algo.updates_per_step)


def rows(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Measures; a row a figure, on a GPU those first that sum up the others."""
    repeats = 3 if options.quick or options.gpu else 7
    first = [stage for stage in _SUMS if stage in options.stages] if options.gpu else []
    rest = [stage for stage in options.stages if stage not in first]
    cases = [options.shadows, options.sizes, options.num_envs, options.physics]
    for stages, (shadows, size, num_envs, physics) in itertools.product(
        (first, rest), itertools.product(*cases)
    ):
        some = argparse.Namespace(**vars(options) | {"stages": stages})
        length = max(2 if options.quick else 8, options.work // num_envs)
        common = {"size": size, "shadows": shadows, "num_envs": num_envs}
        if set(stages) & set(_ENV_STAGES):
            yield from env_rows(some, physics, common, length, repeats)
        if not shadows and set(stages) - set(_ENV_STAGES):
            yield from agent_rows(some, physics, common, length, repeats)


def env_rows(
    options: argparse.Namespace, physics: str, common: dict[str, Any], length: int, repeats: int
) -> Iterator[dict[str, Any]]:
    """Rows of the stages of the environment."""
    size, shadows, num_envs = common["size"], common["shadows"], common["num_envs"]
    env = mjx_arm.make(
        "B", physics=physics, observation="packed", size=(size, size), shadows=shadows
    )
    flags = compiler_options(env.physics)
    state = jax.jit(jax.vmap(mjx_arm.AutoReset(env).reset), compiler_options=flags)(
        jax.random.split(jax.random.key(0), num_envs)
    )[1]
    # The images from outside, or the chunk would render the first one in addition to its steps.
    carry = state, jax.jit(functools.partial(draw, env))(state)
    for stage, run in env_stages(env, num_envs, length).items():
        if stage in options.stages and not (shadows and stage == "physics"):
            figures = time_stage(run, carry, num_envs * length, repeats, flags)
            yield {"stage": stage, **describe(env), **common, **figures}


def agent_rows(
    options: argparse.Namespace, physics: str, common: dict[str, Any], length: int, repeats: int
) -> Iterator[dict[str, Any]]:
    """Rows of the stages of the agent, for both storages where that matters."""
    size, num_envs = common["size"], common["num_envs"]
    for storage in options.storages:
        config = mjx_arm.train_config(
            env="B",
            physics=physics,
            size=(size, size),
            num_envs=num_envs,
            batch_size=options.batch_size,
            storage=storage,
            # Enough for the longest chunk; pixels of more would not fit everywhere.
            replay_size=max(20_000 if storage == "pixels" else 200_000, 8 * num_envs),
            learning_starts=0,
            chunk_steps=num_envs * length,
        )
        # A sample for each step.
        updates = max(1, num_envs // options.batch_size)
        config = set_train_options(config, {"updates_per_step": updates})
        trainer = make_trainer(config)
        flags = compiler_options(trainer.env.physics)
        named = {**describe(trainer.env), **common, "storage": storage}
        named["batch_size"] = config.algo.batch_size
        if "train" in options.stages:
            training = compile_training(config)
            on_cpu = jax.default_backend() == "cpu"
            memory = peak_memory_apart(config) if on_cpu else peak_memory(training)
            yield {"stage": "train", **named, **time_training(training, repeats), **memory}
        if {"act", "learn"} & set(options.stages):
            state = trainer.init(jax.random.key(0))
            for stage, run in agent_stages(config, length).items():
                if stage in options.stages and (stage == "learn" or storage == "states"):
                    updates = _learn_calls(config) * config.algo.updates_per_step
                    work = updates if stage == "learn" else num_envs * length
                    figures = time_stage(run, state, work, repeats, flags)
                    yield {"stage": stage, **named, **figures}


def time_training(training: Training, repeats: int) -> dict[str, float]:
    """Rates of the whole loop."""
    config = training.config
    # The state of one chunk is the next one's.
    state = [training.init(jax.random.key(0))]

    def run() -> Any:
        state[0], counts = training.run_chunk(state[0])
        return counts

    # Once more, for the replay must fill before the first update.
    jax.block_until_ready(run())
    figures = time_chunks(run, config.chunk_length * config.num_envs, repeats)
    return {
        "samples_per_step": config.samples_per_step,
        **figures,
        "compile_s": training.compile_s,
        "planned_bytes": training.planned_bytes,
    }


def describe(env: mjx_arm.Env) -> dict[str, Any]:
    """What a row says of its environment."""
    physics = env.physics
    return {
        "backend": physics.backend,
        "substeps": physics.substeps,
        "timestep": physics.timestep,
    }


def merge(done: list[dict[str, Any]], row: dict[str, Any]) -> None:
    """Adds a row, to the earlier rounds of the same figure where there are any.

    A machine that is shared changes its speed from minute to minute: the median of the rounds
    counts, and their medians are kept beside it.
    """
    names = {"steps_per_s", "least", "most", "compile_s", "planned_bytes", "peak_bytes", "rounds"}
    what = {name: value for name, value in row.items() if name not in names}
    row["rounds"] = [row["steps_per_s"]]
    for old in done:
        if what.items() <= old.items():
            old["rounds"] += row["rounds"]
            old["steps_per_s"] = round(statistics.median(old["rounds"]))
            old["least"] = min(old["least"], row["least"])
            old["most"] = max(old["most"], row["most"])
            return
    done.append(row)


def memory(row: dict[str, Any]) -> str:
    """What the table says of the memory of a row."""
    if "peak_bytes" not in row:
        return ""
    peak, share = row["peak_bytes"] / 1e6, row["peak_bytes"] / row["planned_bytes"]
    return f"   {peak:,.0f} MB, {100 * share:.0f} %"


def plot(rows: list[dict[str, Any]], path: pathlib.Path) -> None:
    """Log-log plot of the figures of 64 by 64 pixels without shadows."""
    # Not on a machine that has only what training itself needs.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    chosen = [row for row in rows if row["size"] == 64 and not row["shadows"]]
    chosen = [row for row in chosen if row.get("storage", "states") == "states"]
    backends = sorted({row["backend"] for row in chosen})
    for stage, backend in itertools.product(STAGES, backends):
        own = [row for row in chosen if (row["stage"], row["backend"]) == (stage, backend)]
        if stage != "learn" and own:
            label = stage if len(backends) == 1 else f"{stage}, {backend}"
            x, y = ([row[name] for row in own] for name in ("num_envs", "steps_per_s"))
            low, high = (np.asarray([row[name] for row in own]) for name in ("least", "most"))
            spread = [np.asarray(y) - low, high - np.asarray(y)]
            axes.errorbar(x, y, spread, marker="o", markersize=4, capsize=2, label=label)
    axes.set(xscale="log", yscale="log", xlabel="environments", ylabel="steps or frames per second")
    axes.grid(alpha=0.3, which="both")
    if chosen:
        axes.legend()
    figure.savefig(path, dpi=110)


def parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="within 2 minutes on two cores")
    parser.add_argument("--json", type=pathlib.Path, help="file for the rows")
    parser.add_argument("--gpu", action="store_true", help="MJX and MJX-Warp on NVIDIA, 10 minutes")
    parser.add_argument("--batch-size", type=int, help="of an update")
    parser.add_argument("--minutes", type=float, help="begin no figure after that")
    parser.add_argument("--rounds", type=int, default=1, help="of all figures, one after another")
    parser.add_argument("--work", type=int, default=8192, help="environment steps of a timed chunk")
    parser.add_argument("--physics", nargs="+", choices=BACKENDS, help="backends")
    parser.add_argument("--stages", nargs="+", choices=STAGES, default=STAGES)
    parser.add_argument("--num-envs", nargs="+", type=int)
    parser.add_argument("--sizes", nargs="+", type=int, default=[64], help="edges, pixels")
    parser.add_argument("--storages", nargs="+", choices=("states", "pixels"))
    parser.add_argument("--shadows", nargs="+", type=int, choices=(0, 1))
    options = parser.parse_args()
    few = options.quick or options.gpu
    if options.gpu:
        if jax.default_backend() != "gpu":
            parser.error(f"--gpu needs an NVIDIA GPU, and jax runs on {jax.default_backend()}")
        options.num_envs = options.num_envs or [8192, 1024]
        options.physics = options.physics or _gpu_backends()
        # A figure that begins then compiles for a minute or two.
        options.minutes = options.minutes or 7.0
        options.work = max(options.work, 131_072)
        options.batch_size = options.batch_size or 1024
    options.physics = options.physics or ["auto"]
    options.batch_size = options.batch_size or 64
    options.num_envs = options.num_envs or ([64] if options.quick else list(NUM_ENVS))
    options.storages = options.storages or (["states"] if few else ["states", "pixels"])
    options.shadows = [bool(x) for x in options.shadows or ([0] if few else [0, 1])]
    return options


def _gpu_backends() -> list[str]:
    if importlib.util.find_spec("warp"):
        return ["mjx", "mjx-warp"]
    print("mjx-warp is left out: its extra is not installed, pip install 'mjx-arm[warp]'")
    return ["mjx"]


def main() -> None:
    """Measures and prints a table; with `--json` writes the rows and a plot."""
    options, done, started = parse(), [], time.monotonic()
    print(
        f"{'stage':<16}{'storage':<9}{'shadows':<9}{'envs':>6}{'physics':>10}{'per second':>12}",
        end="",
    )
    print(f"{'least':>9}{'most':>9}{'compile s':>11}   memory at its peak, of the plan")
    for row in itertools.chain.from_iterable(rows(options) for _ in range(options.rounds)):
        print(
            f"{row['stage']:<16}{row.get('storage', ''):<9}{row['shadows']!s:<9}"
            f"{row['num_envs']:>6}{row['backend']:>10}{row['steps_per_s']:>12,}{row['least']:>9,}{row['most']:>9,}"
            f"{row['compile_s']:>11}{memory(row)}",
            flush=True,
        )
        merge(done, row)
        if options.json:
            options.json.parent.mkdir(parents=True, exist_ok=True)
            report = {"machine": machine(), "rows": done}
            options.json.write_text(json.dumps(report, indent=1) + "\n")
            plot(done, options.json.with_suffix(".png"))
        if options.minutes and time.monotonic() - started > 60 * options.minutes:
            print(f"stopped after {options.minutes:g} minutes")
            break


if __name__ == "__main__":
    main()
