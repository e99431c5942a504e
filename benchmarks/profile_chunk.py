"""Where the time of one training step goes, by stage, beside the least it could take.

Each stage runs alone in a `lax.scan`, at the default preset's sizes, and the whole step last. The
floor of a stage is its operations over the rate of a large matrix product, or the bytes that it
must read and write over the rate of a large copy, whichever takes longer. Operations are XLA's own
count; the bytes are those of what the stage takes and gives, not of what it keeps in between.

    python benchmarks/profile_chunk.py --json benchmarks/results/profile.json
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import pathlib
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from machine import machine

import mjx_arm
from mjx_arm.algos.replay import sample
from mjx_arm.physics import compiler_options
from mjx_arm.training.loop import Body, LoopState, make_body
from mjx_arm.training.memory import tree_size


def best_of(run: Callable[[], Any], repeats: int) -> float:
    """Seconds of the fastest of several calls, after one that does not count."""
    jax.block_until_ready(run())
    seconds = []
    for _ in range(repeats):
        started = time.perf_counter()
        jax.block_until_ready(run())
        seconds.append(time.perf_counter() - started)
    return min(seconds)


def peaks(repeats: int) -> dict[str, float]:
    """Operations a second of a large float32 product, and bytes a second of a large copy."""
    n = 2048
    a = jnp.ones((n, n), jnp.float32)
    product = jax.jit(lambda a: a @ a)
    x = jnp.ones((64_000_000,), jnp.float32)
    copy = jax.jit(lambda x: x + 1.0)
    return {
        "flops_per_s": 2 * n**3 / best_of(lambda: product(a), repeats),
        "bytes_per_s": 2 * x.nbytes / best_of(lambda: copy(x), repeats),
    }


def stages(body: Body) -> dict[str, tuple[Callable[[Any], Any], Any]]:
    """Each stage as a function from a carry to the next one, with the first carry."""
    config = body.config
    env, algorithm = body.env, body.algorithm
    frames, learning = algorithm.frames, algorithm.q_learning
    state = jax.jit(body.init, compiler_options=compiler_options(env.env.physics))(
        jax.random.key(0)
    )
    key, size = jax.random.key(1), config.algo.batch_size
    keys = jax.random.split(key, config.num_envs)
    action = jax.random.randint(key, (config.num_envs,), 0, 14)
    full = state.replay.replace(count=jnp.int32(config.replay_slots))
    batch = sample(full, key, size, config.algo.n_step, config.algo.gamma)
    obs, next_obs = frames.decode(batch.frame), frames.decode(batch.next_frame)

    def render(envs: Any) -> Any:
        image = jax.vmap(env.env.observe)(envs.env)
        # Depends on the image, or XLA would leave the rendering out.
        shift = 1e-9 * jnp.sum(image & 1, axis=(1, 2)).astype(jnp.float32)
        physics = envs.env.physics
        poses = physics.poses.replace(geom_xpos=physics.poses.geom_xpos + shift[:, None, None])
        return envs.replace(env=envs.env.replace(physics=physics.replace(poses=poses)))

    def act(obs: jax.Array) -> jax.Array:
        q = algorithm.apply(state.learner.params, obs)
        return obs ^ (q[:, :1, None] > 1e9).astype(jnp.uint32)

    # The pictures change places, or what depends on them alone would be made once for all passes.
    def gradient(carry: Any) -> Any:
        params, obs, next_obs = carry

        def loss(params: Any) -> jax.Array:
            return jnp.sum(algorithm.apply(params, obs) ** 2)

        params = jax.tree.map(lambda p, g: p - 1e-9 * g, params, jax.grad(loss)(params))
        return params, next_obs, obs

    def render_batch(frame: Any) -> Any:
        image = frames.decode(frame)
        shift = 1e-9 * jnp.sum(image & 1, axis=(1, 2)).astype(jnp.float32)[:, None]
        return frame | {"qpos": frame["qpos"] + shift}

    def update(carry: Any) -> Any:
        learner, obs, next_obs = carry
        return learning.update(learner, batch, obs, next_obs)[0], next_obs, obs

    def learn(carry: Any) -> Any:
        learner, key = carry
        key, own = jax.random.split(key)
        return algorithm.learn(own, learner, full, jnp.int32(config.replay.replay_size))[0], key

    both = jax.tree.map(lambda *x: jnp.concatenate(x), batch.frame, batch.next_frame)
    return {
        "physics": (lambda envs: jax.vmap(env.transition)(keys, envs, action)[0], state.envs),
        "render": (render, state.envs),
        "act: forward": (act, state.obs),
        "learn: render the batch": (render_batch, both),
        "learn: forward and backward": (gradient, (state.learner.params, obs, next_obs)),
        "learn: update without rendering": (update, (state.learner, obs, next_obs)),
        "learn": (learn, (state.learner, key)),
        "whole step": (lambda s: body.step(s, None)[0], state.replace(replay=full)),
    }


def profile(
    stage: Callable[[Any], Any],
    whole: Callable[[Any], Any],
    carry: Any,
    peak: dict[str, float],
    options: Any,
    repeats: int,
) -> dict[str, float]:
    """Milliseconds of a stage inside a scan, and its floor.

    `whole` is the stage with each batch in one part: XLA counts the body of a loop once.
    """
    length = 20

    def run(carry: Any) -> Any:
        return jax.lax.scan(lambda c, _: (stage(c), None), carry, None, length=length)[0]

    compiled = jax.jit(run, compiler_options=options).lower(carry).compile()
    seconds = best_of(lambda: compiled(carry), repeats) / length
    once = jax.jit(whole, compiler_options=options).lower(carry).compile().cost_analysis() or {}
    flops = once.get("flops", 0.0)
    # Of the replay a step touches next to nothing.
    touched = carry.replace(replay=None) if isinstance(carry, LoopState) else carry
    moved = 2 * tree_size(touched)
    floor = max(flops / peak["flops_per_s"], moved / peak["bytes_per_s"])
    return {
        "ms": round(1e3 * seconds, 3),
        "floor_ms": round(1e3 * floor, 3),
        "mflop": round(flops / 1e6, 1),
        "megabytes": round(moved / 1e6, 1),
    }


def main() -> None:
    """Measures, prints a table and, where asked to, writes the figures to a file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--json", type=pathlib.Path, help="file for the figures")
    options = parser.parse_args()
    config = mjx_arm.PRESETS["pixels"]
    peak = peaks(options.repeats)
    print(f"{peak['flops_per_s'] / 1e9:.0f} GFLOP/s, {peak['bytes_per_s'] / 1e9:.1f} GB/s")
    print(f"{'stage':<32}{'ms':>8}{'floor':>8}{'MFLOP':>9}{'MB':>9}")
    body = make_body(config)
    flags = compiler_options(body.env.env.physics)
    learning = dataclasses.replace(body.algorithm.q_learning, microbatches=1)
    algorithm = dataclasses.replace(body.algorithm, q_learning=learning)
    in_one = stages(dataclasses.replace(body, algorithm=algorithm))
    rows = []
    for name, (stage, carry) in stages(body).items():
        row = profile(stage, in_one[name][0], carry, peak, flags, options.repeats)
        rows.append({"stage": name, **row})
        figures = f"{row['ms']:>8.2f}{row['floor_ms']:>8.2f}{row['mflop']:>9.1f}"
        print(f"{name:<32}{figures}{row['megabytes']:>9.1f}", flush=True)
    if options.json:
        report = {"machine": machine(), "peak": peak, "rows": rows}
        options.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
