"""How well agents do, in the task as the environment's name fixes it.

    python benchmarks/agents.py agent-a agent-b --json benchmarks/results/agents.json
    python benchmarks/agents.py runs/NAME --env B

For each agent: its success rate in environments A and B, 1,000 held-out episodes each at epsilon
0.1, with a 95 % interval; in the environment that it was trained in also

- how its failures ended: cube never grasped, or grasped and not lifted;
- the median length of its successful episodes, beside that of the scripted policy, which sees the
  simulator's state, from the same starts without random actions;
- its rate with MJX's physics, and the difference to MuJoCo's, 200 episodes each;
- its rate with a blank image, and with the image of another episode: a control.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import pathlib
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from machine import machine

import mjx_arm
from mjx_arm.algos.exploration import epsilon_greedy
from mjx_arm.envs.scripted import make_scripted_policy
from mjx_arm.physics import compiler_options
from mjx_arm.training.agent import Agent
from mjx_arm.training.evaluate import Evaluation, evaluate
from mjx_arm.training.loop import EVALUATION, role_key

EPSILON = 0.1
EPISODES, FEW = 1_000, 200
SEED = 21


def judge(agent: Agent, episodes: int, apply: Callable[..., Any] | None = None) -> Evaluation:
    """An evaluation on held-out starts, the same ones for all agents."""
    return evaluate(
        agent.env,
        apply or agent.apply,
        agent.params,
        episodes=episodes,
        epsilon=EPSILON,
        key=role_key(SEED, EVALUATION),
    )


def lengths(agent: Agent, *, scripted: bool) -> list[int]:
    """Steps of the successful ones of `FEW` episodes, all from the same starts."""
    env = agent.env
    policy = make_scripted_policy(env)
    start_key, key = jax.random.split(role_key(SEED, EVALUATION))

    @jax.jit
    def start(key: jax.Array) -> Any:
        return jax.vmap(env.reset)(jax.random.split(key, FEW))

    def act(key: jax.Array, obs: Any, state: Any) -> jax.Array:
        if scripted:
            return jax.vmap(policy)(state)
        q = agent.apply(agent.params, obs)
        return epsilon_greedy(key, q, jnp.full((FEW,), EPSILON, jnp.float32))

    def step(carry: Any, key: jax.Array) -> tuple[Any, jax.Array]:
        obs, state = carry
        state, transition = jax.vmap(env.transition)(state, act(key, obs, state))
        return (jax.vmap(env.observe)(state), state), transition.terminated

    run = jax.jit(
        lambda carry, keys: jax.lax.scan(step, carry, keys),
        compiler_options=compiler_options(env.physics),
    )
    carry, found = start(start_key), np.zeros(FEW, int)
    for i in range(0, 1_000, 100):
        carry, ended = run(carry, jax.random.split(jax.random.fold_in(key, i), 100))
        ended = np.asarray(ended)
        first = np.where(ended.any(axis=0), i + 1 + ended.argmax(axis=0), 0)
        found = np.where(found == 0, first, found)
    return [int(x) for x in found if x]


def difference(one: Evaluation, other: Evaluation) -> dict[str, Any]:
    """`one - other` in percent, with its 95 % interval (normal approximation)."""
    gap = one.rate - other.rate
    parts = (x.rate * (1 - x.rate) / x.episodes for x in (one, other))
    half = 1.96 * math.sqrt(sum(parts))
    return {"percent": 100 * gap, "ci95": [100 * (gap - half), 100 * (gap + half)]}


def measure(name: str, only: str | None) -> Iterator[dict[str, Any]]:
    """The figures of one agent, as they are taken."""
    own = mjx_arm.load_agent(name).trained_env.env
    yield {"trained_in": own, "epsilon": EPSILON}
    for env in ("A", "B"):
        if only in (None, env):
            result = judge(mjx_arm.load_agent(name, env=env), EPISODES)
            yield {f"in_{env}": dataclasses.asdict(result)}
    if only not in (None, own):
        return
    native = mjx_arm.load_agent(name, env=own, physics="native")
    for key, scripted in (("agent", False), ("scripted", True)):
        found = lengths(native, scripted=scripted)
        yield {f"median_length_{key}": float(np.median(found)), f"successes_{key}": len(found)}
    blank = judge(native, FEW, lambda p, obs: native.apply(p, jnp.zeros_like(obs)))
    other = judge(native, FEW, lambda p, obs: native.apply(p, jnp.roll(obs, 1, axis=0)))
    yield {"blank_image": blank.rate, "image_of_another_episode": other.rate}
    mjx = mjx_arm.load_agent(name, env=own, physics="mjx")
    by_native, by_mjx = judge(native, FEW), judge(mjx, FEW)
    yield {
        "native": dataclasses.asdict(by_native),
        "mjx": dataclasses.asdict(by_mjx),
        "mjx_minus_native": difference(by_mjx, by_native),
    }


def main() -> None:
    """Judges the agents, prints each figure and, where asked to, writes it as it comes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("agents", nargs="+", help="names of shipped agents, files or run folders")
    parser.add_argument("--env", choices=("A", "B"), help="only in this environment")
    parser.add_argument("--json", type=pathlib.Path, help="file to add the results to")
    options = parser.parse_args()
    for name in options.agents:
        row: dict[str, Any] = {"machine": machine()}
        for figures in measure(name, options.env):
            print(name, json.dumps(figures), flush=True)
            row |= figures
            if options.json:
                rows = json.loads(options.json.read_text()) if options.json.is_file() else {}
                options.json.write_text(json.dumps(rows | {name: row}, indent=1) + "\n")


if __name__ == "__main__":
    main()
