"""Measurements of a trained agent: episodes of Table 1, the greedy one of Figure 4, its network."""

from __future__ import annotations

import dataclasses
import hashlib
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from mjx_arm.networks.q_network import PixelQNetwork, make_network
from mjx_arm.reproduce.james_johns import EPISODES as PAPER_EPISODES
from mjx_arm.reproduce.layers import count_params, layers_of
from mjx_arm.reproduce.records import (
    CAUSES,
    REACH,
    cause_of,
    count_opens,
    height_histogram,
    marks_of,
    random_opens,
    summarise,
)
from mjx_arm.reproduce.rollouts import Rollout, roll_out
from mjx_arm.reproduce.strips import animation, enlarge, make_frames, strip
from mjx_arm.training.agent import Agent, find_agent, load_agent
from mjx_arm.training.evaluate import wilson_interval
from mjx_arm.training.loop import EVALUATION, role_key

EPSILON = 0.1
# Of starts and random actions; neither training nor selection has seen it.
_SEED = 21
_TILE, _TILES = 176, 6
_MOST_FRAMES, _BEFORE = 60, 16
_MILLISECONDS = 80

Result = tuple[dict[str, Any], dict[str, bytes]]


@dataclasses.dataclass(frozen=True)
class Trial:
    """How an agent is tried.

    Attributes:
      env: `A` or `B`.
      episodes: number of episodes.
      epsilon: share of random actions.
      max_steps: iterations until an episode is truncated.
    """

    env: str
    episodes: int
    epsilon: float = EPSILON
    max_steps: int = 1_000


def agent_digest(agent: str) -> str:
    """SHA-256 of an agent's file, in hexadecimal digits.

    Args:
      agent: what `load_agent` takes.

    Raises:
      ValueError: there is no such agent.
    """
    return hashlib.sha256(find_agent(pathlib.Path(agent)).read_bytes()).hexdigest()


def trial_inputs(agent: str, trial: Trial) -> dict[str, Any]:
    """What a trial depends on, as a JSON object: the digest of the agent's file, and the options.

    Args:
      agent: what `load_agent` takes.
      trial: how the agent is tried.

    Raises:
      ValueError: there is no such agent.
    """
    return {
        "agent_sha256": agent_digest(agent),
        "seed": _SEED,
        "reach": REACH,
        **dataclasses.asdict(trial),
    }


def _run(agent: Agent, trial: Trial) -> list[Rollout]:
    return roll_out(
        agent.env,
        agent.apply,
        agent.params,
        episodes=trial.episodes,
        epsilon=trial.epsilon,
        key=role_key(_SEED, EVALUATION),
    )


def _load(path: str, trial: Trial) -> Agent:
    return load_agent(path, env=trial.env, max_steps=trial.max_steps)


def measure_episodes(name: str, path: str, trial: Trial, *, pictures: bool) -> Result:
    """Episodes of an agent: success, causes of failure, random opens, heights, and each start.

    Args:
      name: of the cell, for its pictures.
      path: what `load_agent` takes.
      trial: how it is tried.
      pictures: a strip of each cause of failure, and an animation of a grasp that was lost and
        found again.
    """
    agent = _load(path, trial)
    rollouts = _run(agent, trial)
    task: Any = agent.env.task
    result = _shares(rollouts) | {
        "env_steps": agent.env_steps,
        "trained_in": agent.trained_env.env,
        "rectangle": agent.env.scene.numbers("cube_rectangle", 4).tolist(),
        "noise_degrees": agent.env.config.noise_degrees,
        "causes": {cause: sum(cause_of(x) == cause for x in rollouts) for cause in CAUSES},
        "opens": count_opens(rollouts, agent.env.arm.open_action),
        "heights": height_histogram(rollouts, task.config.lift),
        "episodes_each": summarise(rollouts, agent.env.arm, task.cube_qpos),
    }
    made = {}
    if pictures:
        made = _strips(name, agent, rollouts) | _animation(name, agent, rollouts)
    return result, made


def _shares(rollouts: Sequence[Rollout]) -> dict[str, Any]:
    successes, episodes = sum(x.success for x in rollouts), len(rollouts)
    few = rollouts[:PAPER_EPISODES]
    return {
        "episodes": episodes,
        "successes": successes,
        "rate": successes / episodes,
        "ci95": list(wilson_interval(successes, episodes)),
        "first_episodes": len(few),
        "first_successes": sum(x.success for x in few),
        "held_not_lifted": sum(bool(x.grasped.any()) and not x.success for x in rollouts),
        "mean_length": float(np.mean([len(x) for x in rollouts])),
        "median_length_of_successes": _median([len(x) for x in rollouts if x.success]),
        "mean_max_q": float(np.mean(np.concatenate([x.max_q for x in rollouts]))),
    }


def _median(values: Sequence[int]) -> float | None:
    return float(np.median(values)) if values else None


def _strips(name: str, agent: Agent, rollouts: Sequence[Rollout]) -> dict[str, bytes]:
    """A strip of the first episode of each cause of failure."""
    render, made = make_frames(agent.env, edge=_TILE), {}
    for cause in CAUSES:
        failed = [rollout for rollout in rollouts if cause_of(rollout) == cause]
        if failed:
            frames = np.linspace(0, len(failed[0]), _TILES).round().astype(int)
            images = render(failed[0].qpos[frames], failed[0].params)
            made[f"{name}-{cause}.png"] = strip([images], [[f"step {x}" for x in frames]])
    return made


def _animation(name: str, agent: Agent, rollouts: Sequence[Rollout]) -> dict[str, bytes]:
    """A random open that drops the cube, and the way to success after it, as short as there is."""
    open_action = agent.env.arm.open_action
    found = [
        (len(rollout) - each.step, i, each.step)
        for i, rollout in enumerate(rollouts)
        if rollout.success
        for each in random_opens(rollout, open_action)
        if each.kind == "dropped"
    ]
    if not found:
        return {}
    _, i, step = min(found)
    rollout = rollouts[i]
    frames = np.arange(max(0, step - _BEFORE), len(rollout) + 1)
    frames = frames[:: -(-len(frames) // _MOST_FRAMES)]
    if frames[-1] != len(rollout):
        frames = np.append(frames, len(rollout))
    grasped = np.concatenate([[False], rollout.grasped])
    labels = [_moment(int(frame), step, grasped, len(rollout)) for frame in frames]
    images = make_frames(agent.env, edge=192)(rollout.qpos[frames], rollout.params)
    return {f"{name}-again.gif": animation(images, labels, milliseconds=_MILLISECONDS)}


def _moment(frame: int, opened: int, grasped: np.ndarray, end: int) -> str:
    """What happens in a frame, for its label."""
    if frame == end:
        return f"step {frame}: success"
    if opened < frame <= opened + 5:
        return f"step {frame}: random open"
    return f"step {frame}: {'grasped' if grasped[frame] else 'not grasped'}"


def measure_greedy(name: str, path: str, trial: Trial) -> Result:
    """The Q-values along the successful greedy episode of median length, with five marked frames.

    Args:
      name: of the cell, for its picture.
      path: what `load_agent` takes.
      trial: how it is tried.

    Returns:
      Without a success `episode` is None, and there is no picture.
    """
    agent = _load(path, trial)
    rollouts = _run(agent, trial)
    result = _shares(rollouts) | {"episode": None}
    successes = sorted((x for x in rollouts if x.success), key=len)
    if not successes:
        return result, {}
    chosen = successes[len(successes) // 2]
    marks = marks_of(chosen)
    frames = np.asarray([mark.frame for mark in marks])
    result["episode"] = {
        "length": len(chosen),
        "reward_scale": agent.config.env.reward_scale,
        "q": _rounded(chosen.max_q),
        "distance": _rounded(chosen.distance),
        "height": _rounded(chosen.height),
        "grasped": chosen.grasped.astype(int).tolist(),
        "marks": [dataclasses.asdict(mark) for mark in marks],
    }
    large = make_frames(agent.env, edge=_TILE)(chosen.qpos[frames], chosen.params)
    seen = make_frames(agent.env)(chosen.qpos[frames], chosen.params)
    labels = [f"{i + 1}: {mark.name}, step {mark.frame}" for i, mark in enumerate(marks)]
    sheet = strip([large, enlarge(seen, _TILE)], [labels, []])
    return result, {f"{name}.png": sheet}


def _rounded(values: np.ndarray) -> list[float]:
    return [round(float(x), 4) for x in values]


def measure_network(path: str) -> Result:
    """The layers of an agent's network.

    Raises:
      ValueError: the network is not the shipped one for pixels.
    """
    agent = load_agent(path)
    config = agent.config
    network = make_network(config.network, num_actions=agent.env.num_actions, feature_scales=None)
    if not isinstance(network, PixelQNetwork) or config.env.observation != "packed":
        raise ValueError(f"{path} has another network than the one for pixels: no layer table")
    layers = layers_of(network, size=config.env.size, cameras=len(config.env.cameras))
    return {
        "layers": [dataclasses.asdict(layer) for layer in layers],
        "params": count_params(agent.params),
        "operations": sum(layer.operations for layer in layers),
        "num_actions": agent.env.num_actions,
    }, {}
