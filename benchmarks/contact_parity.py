"""How closely MJX follows MuJoCo in contact, and what more solver iterations would cost.

    python benchmarks/contact_parity.py --json benchmarks/results/contact_parity.json

States come from rollouts under native physics: a policy that pushes the cube about, random actions,
and random actions with a grasped cube. Only states with more contacts than the four of a cube at
rest count. Each is stepped once (one iteration) by both backends. A state disagrees if any entry
of `qpos` (m, rad) differs by more than `--tolerance`.

`--scenes OLD NEW` measures two scenes on states of their own, and times their physics in
alternating rounds.
"""

from __future__ import annotations

import argparse
import functools
import json
import pathlib
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from machine import machine

import mjx_arm
from mjx_arm.envs.scripted import make_scripted_policy
from mjx_arm.physics import PhysicsState, compiler_options, make_physics

# Of a cube at rest on the table.
RESTING_CONTACTS = 4
SUBSTEPS = 2
LENGTH = 240
EVERY = 12

Policy = Callable[[jax.Array, Any], jax.Array]


def make_random_policy(env: mjx_arm.Env) -> Policy:
    """A random action."""
    return lambda key, state: jax.random.randint(key, (), 0, env.num_actions)


def make_pushing_policy(env: mjx_arm.Env) -> Policy:
    """Goes for the cube, but opens, closes and turns at random on the way."""
    scripted = make_scripted_policy(env)
    open_, close = env.arm.open_action, env.arm.close_action

    def policy(key: jax.Array, state: Any) -> jax.Array:
        choose, which = jax.random.split(key)
        draw = jax.random.uniform(choose)
        gripper = jax.random.choice(which, jnp.asarray([open_, close, close], jnp.int32))
        turn = jax.random.randint(which, (), 0, open_)
        return jnp.where(draw < 0.05, gripper, jnp.where(draw < 0.4, turn, scripted(state)))

    return policy


def rollout(env: mjx_arm.Env, policy: Policy, num_envs: int, seed: int) -> dict[str, np.ndarray]:
    """States of every `EVERY`th step and the controls that follow, flat over time."""
    reset_key, key = jax.random.split(jax.random.key(seed))

    def step(state: Any, key: jax.Array) -> Any:
        action = jax.vmap(policy)(jax.random.split(key, num_envs), state)
        after, _ = jax.vmap(env.transition)(state, action)
        return after, (state.physics.integration, after.ctrl)

    def run(reset_key: jax.Array, key: jax.Array) -> Any:
        start = jax.vmap(env.reset)(jax.random.split(reset_key, num_envs))[1]
        return jax.lax.scan(step, start, jax.random.split(key, LENGTH))[1]

    rows, ctrl = jax.device_get(jax.jit(run)(reset_key, key))
    model = env.scene.mj_model
    carried = rows[EVERY - 1 :: EVERY].reshape(-1, rows.shape[-1]).view(np.float64)
    time_, qpos, qvel, warmstart = np.split(
        carried, np.cumsum([1, model.nq, model.nv]).tolist(), axis=1
    )
    del time_
    ctrl = ctrl[EVERY - 1 :: EVERY].reshape(len(qpos), -1)
    found = {"qpos": qpos, "qvel": qvel, "warmstart": warmstart, "ctrl": ctrl}
    return {name: x.astype(np.float32) for name, x in found.items()}


def contact_counts(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Touching contacts of each state, by MuJoCo C: `[S] int`."""
    data, counts = mujoco.MjData(model), []
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_fwdPosition(model, data)
        counts.append(int(data.ncon))
    return np.asarray(counts)


def contact_states(scene: str, num_envs: int, most: int) -> dict[str, np.ndarray]:
    """At most `most` states that are rich in contacts, evenly from all rollouts."""
    env = mjx_arm.make("B", physics="native", observation="state", placement="always", scene=scene)
    held = mjx_arm.make("B", physics="native", observation="state", start="in_grasp", scene=scene)
    cases = (
        (env, make_pushing_policy(env)),
        (env, make_random_policy(env)),
        (held, make_random_policy(held)),
    )
    parts = [rollout(used, policy, num_envs, seed) for seed, (used, policy) in enumerate(cases)]
    states = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    rich = np.flatnonzero(contact_counts(env.scene.mj_model, states["qpos"]) > RESTING_CONTACTS)
    rich = np.random.default_rng(0).permutation(rich)[:most]
    return {name: values[rich] for name, values in states.items()}


def after_native(model: mujoco.MjModel, states: dict[str, np.ndarray]) -> np.ndarray:
    """`qpos` after one iteration of a plain `mj_step` loop: `[S, nq]`."""
    data, after = mujoco.MjData(model), []
    for qpos, qvel, warmstart, ctrl in zip(*(states[name] for name in states), strict=True):
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, ctrl
        data.qacc_warmstart[:] = warmstart
        for _ in range(SUBSTEPS):
            mujoco.mj_step(model, data)
        after.append(data.qpos.copy())
    return np.asarray(after)


def mjx_step(model: mujoco.MjModel, iterations: int, line_search: int) -> Any:
    """MJX's physics with given solver and line search iterations, and its jit options."""
    counts = iterations, line_search
    physics = make_physics(model, "mjx", substeps=SUBSTEPS, mjx_iterations=counts)
    return physics, compiler_options(physics)


def start_of(physics: Any, states: dict[str, np.ndarray]) -> PhysicsState:
    """The states as MJX carries them."""
    start = jax.jit(jax.vmap(physics.init))(states["qpos"], states["ctrl"])
    return start.replace(qvel=states["qvel"], integration=states["warmstart"])


def rate(run: Callable[[], Any], work: int, repeats: int) -> float:
    """Median of `work` units a second."""
    rates = []
    for _ in range(repeats):
        started = time.perf_counter()
        jax.block_until_ready(run())
        rates.append(work / (time.perf_counter() - started))
    return statistics.median(rates)


def stepping(physics: Any, options: Any, states: dict[str, np.ndarray], length: int) -> Any:
    """A compiled run of `length` iterations from the first states: `run()`, after a warm-up."""

    def run(state: PhysicsState, ctrl: jax.Array) -> PhysicsState:
        body = lambda s, _: (jax.vmap(physics.step)(s, ctrl), None)  # noqa: E731
        return jax.lax.scan(body, state, None, length=length)[0]

    ctrl = jnp.asarray(states["ctrl"])
    start = jax.jit(jax.vmap(physics.init))(jnp.asarray(states["qpos"]), ctrl)
    compiled = jax.jit(run, compiler_options=options).lower(start, ctrl).compile()
    jax.block_until_ready(compiled(start, ctrl))
    return lambda: compiled(start, ctrl)


def curve(scene: str, options: argparse.Namespace) -> list[dict[str, Any]]:
    """Disagreement and speed for each number of solver iterations."""
    states = contact_states(scene, options.num_envs, options.states)
    model = mjx_arm.load_scene(scene).mj_model
    expected, count = after_native(model, states), len(states["qpos"])
    rows = []
    for iterations in options.iterations:
        for line_search in options.line_search:
            physics, flags = mjx_step(model, iterations, line_search)
            step = jax.jit(jax.vmap(physics.step), compiler_options=flags)
            start, ctrl = start_of(physics, states), jnp.asarray(states["ctrl"])
            after = np.asarray(jax.block_until_ready(step(start, ctrl)).qpos, np.float64)
            difference = np.abs(after - expected).max(axis=1)
            row = {
                "scene": pathlib.Path(scene).stem,
                "iterations": iterations,
                "line_search": line_search,
                "states": count,
                "disagree": float((difference > options.tolerance).mean()),
                "median": float(np.median(difference)),
                "p90": float(np.quantile(difference, 0.9)),
                "p99": float(np.quantile(difference, 0.99)),
                "steps_per_s": round(
                    rate(functools.partial(step, start, ctrl), count, options.repeats)
                ),
            }
            print(json.dumps(row), flush=True)
            rows.append(row)
    return rows


def ratios(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Speed of the second scene over the first's, in alternating rounds."""
    rows = []
    for backend in options.backends:
        runs, works = [], []
        length = options.length if backend == "mjx" else 20 * options.length
        for scene in options.scenes:
            loaded = mjx_arm.load_scene(scene)
            states = contact_states(scene, options.num_envs, options.speed_envs)
            if backend == "native":
                physics, flags = make_physics(loaded.mj_model, "native", substeps=SUBSTEPS), {}
            else:
                physics, flags = mjx_step(loaded.mj_model, *loaded.mjx_iterations)
            runs.append(stepping(physics, flags, states, length))
            works.append(len(states["qpos"]) * length)
        rounds = [
            [rate(run, work, 1) for run, work in zip(runs, works, strict=True)]
            for _ in range(options.rounds)
        ]
        first, second = (statistics.median(x) for x in zip(*rounds, strict=True))
        row = {
            "backend": backend,
            "scenes": [pathlib.Path(scene).stem for scene in options.scenes],
            "environments": options.speed_envs,
            "steps_per_s": [round(first), round(second)],
            "ratio": statistics.median(b / a for a, b in rounds),
            "ratios": [round(b / a, 3) for a, b in rounds],
        }
        print(json.dumps(row), flush=True)
        rows.append(row)
    return rows


def parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=pathlib.Path, help="file for the rows")
    parser.add_argument("--scenes", nargs="+", default=["arm_cube"], help="names or MJCF paths")
    parser.add_argument("--iterations", nargs="*", type=int, default=[5, 6, 7, 8, 10])
    parser.add_argument("--line-search", nargs="+", type=int, default=[8])
    parser.add_argument("--tolerance", type=float, default=5e-3, help="of qpos, m and rad")
    parser.add_argument("--states", type=int, default=915, help="maximum number of states")
    parser.add_argument("--num-envs", type=int, default=64, help="in the rollouts")
    parser.add_argument("--repeats", type=int, default=5, help="of a timed step")
    parser.add_argument("--rounds", type=int, default=5, help="alternating rounds of two scenes")
    parser.add_argument("--speed-envs", type=int, default=256, help="environments in a round")
    parser.add_argument("--length", type=int, default=8, help="iterations in a round")
    parser.add_argument("--backends", nargs="+", default=["mjx", "native"])
    return parser.parse_args()


def main() -> None:
    """Measures, prints a row a line, and with `--json` writes them."""
    options = parse()
    report: dict[str, Any] = {"machine": machine(), "tolerance": options.tolerance}
    report["curve"] = [row for scene in options.scenes for row in curve(scene, options)]
    if len(options.scenes) == 2:
        report["speed"] = ratios(options)
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
