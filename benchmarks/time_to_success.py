"""How long Stable-Baselines3's DQN takes to lift the cube in environment A, beside our own runs.

    .venv-peers/bin/python benchmarks/time_to_success.py runs/NAME --json FILE

The time of ours is in the metrics of a run: that of the first selection in which 90 % of the
held-out episodes succeeded. Stable-Baselines3 then trains for at most 5 times as long, once with
the best of ours (our network, 64 of our environments in one call, our reward, exploration, 3-step
returns and averaged target, which also is what is judged), once with its defaults on one of our
environments, and is judged as often and in the same way. Both take hours: with `--keep FOLDER` they
are saved at every judgement, which their time does not count, and the same command resumes them.

Without a run ours is what the file of results has from before, and theirs is added to it.

Side by side, each on a core of its own (`taskset -c 0 make train`, `taskset -c 1 ... --threads 1`),
ours and one of theirs share what else the machine does; several commands write to one file.
"""

from __future__ import annotations

import argparse
import json
import math
import pathlib
import shutil
import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import torch
from machine import machine
from peers import TorchNetwork
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from mjx_arm.config import TrainConfig
from mjx_arm.interop.sb3 import ArmCubeVecEnv
from mjx_arm.presets import PRESETS
from mjx_arm.report.metrics import read_metrics
from mjx_arm.training.evaluate import wilson_interval
from mjx_arm.training.run_folder import load_config

_GOAL = 0.9
_EPSILON = 0.1
_SEED = 2_000_003


def our_time(folder: pathlib.Path) -> dict[str, Any]:
    """When a run of ours first had what is asked for; judged by its own selections."""
    config = load_config(folder)
    judged = [
        {
            "minutes": row["wall_s"] / 60,
            "env_steps": row["env_steps"],
            "rate": row["selection_rate"],
        }
        for row in read_metrics(folder)
        if math.isfinite(row["selection_rate"])
    ]
    reached = next((row for row in judged if row["rate"] >= _GOAL), None)
    return {
        "learner": "mjx_arm",
        "seed": config.seed,
        "episodes": config.select_episodes,
        "judged": judged,
        "reached": reached,
    }


class Extractor(BaseFeaturesExtractor):
    """Our convolutions and first dense layer."""

    def __init__(self, space: gymnasium.spaces.Box, config: TrainConfig):
        super().__init__(space, config.network.hidden)
        self.body = TorchNetwork(config).body

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Features `[B, hidden]` of images `[B, 3, H, W]` in 0 to 1."""
        return self.body(images - 0.5)


def best_of_ours(config: TrainConfig, total_steps: int) -> DQN:
    """Stable-Baselines3's DQN with all of our settings that it has."""
    envs = make_envs(config, config.num_envs)
    return DQN(
        "CnnPolicy",
        envs,
        learning_rate=config.algo.learning_rate,
        buffer_size=config.replay.replay_size,
        learning_starts=config.algo.learning_starts,
        batch_size=config.algo.batch_size,
        tau=config.algo.polyak,
        gamma=config.algo.gamma,
        train_freq=1,
        gradient_steps=config.algo.updates_per_step,
        n_steps=config.algo.n_step,
        target_update_interval=1,
        exploration_fraction=config.exploration.epsilon_steps / total_steps,
        exploration_final_eps=config.exploration.epsilon_end,
        max_grad_norm=config.algo.max_grad_norm,
        policy_kwargs={
            "features_extractor_class": Extractor,
            "features_extractor_kwargs": {"config": config},
            "net_arch": [],
        },
        seed=config.seed,
    )


def defaults(config: TrainConfig, total_steps: int) -> DQN:
    """Its defaults, on one of our environments with our reward, but for the size of its buffer.

    A million images and what follows them would take 25 GB; before step 100,000 it is all the same.
    """
    del total_steps
    return DQN("CnnPolicy", make_envs(config, 1), buffer_size=100_000, seed=config.seed)


LEARNERS: dict[str, tuple[Callable[[TrainConfig, int], DQN], bool]] = {
    "sb3, best of ours": (best_of_ours, True),
    "sb3, defaults": (defaults, False),
}


def make_envs(config: TrainConfig, num_envs: int, **changes: Any) -> ArmCubeVecEnv:
    """Our environments with the reward and the length of episodes of a run."""
    env = config.env
    options = {"reward": env.reward, "reward_scale": env.reward_scale}
    options |= {"max_steps": env.max_steps, "size": env.size} | changes
    return ArmCubeVecEnv(env.env, num_envs, physics="native", **options)


class Judge:
    """Tries an agent: one episode in each of `select_episodes` environments, all counted."""

    def __init__(self, config: TrainConfig):
        self._envs = make_envs(config, config.select_episodes, max_steps=1000)

    def success_rate(self, network: nn.Module) -> float:
        """Share of the episodes in which the cube was lifted, at epsilon 0.1."""
        count, random = self._envs.num_envs, np.random.default_rng(_SEED)
        self._envs.seed(_SEED)
        obs, open_, successes = self._envs.reset(), np.ones(count, bool), 0
        while open_.any():
            with torch.inference_mode():
                best = network(torch.as_tensor(obs.transpose(0, 3, 1, 2))).argmax(-1).numpy()
            explore = random.random(count) < _EPSILON
            action = np.where(explore, random.integers(14, size=count), best)
            obs, _, ended, infos = self._envs.step(action)
            successes += sum(bool(infos[i]["success"]) for i in np.flatnonzero(ended & open_))
            open_ &= ~ended
        return successes / count


class Judging(BaseCallback):
    """Judges every `every` steps, and stops at the goal or when the time is over."""

    def __init__(
        self,
        judge: Judge,
        *,
        every: int,
        minutes: float,
        averaged: bool,
        before: dict[str, Any] | None,
        report: Callable[[dict[str, Any], BaseAlgorithm], None],
    ):
        super().__init__()
        self._judge, self._every, self._minutes = judge, every, minutes
        self._averaged, self._report = averaged, report
        self._next = every + (before["env_steps"] if before else 0)
        self._started = time.perf_counter() - 60 * (before["minutes"] if before else 0)

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._next:
            self._next += self._every
            policy = self.model.policy
            network = policy.q_net_target if self._averaged else policy.q_net
            network.set_training_mode(False)
            rate = self._judge.success_rate(network)
            row = {"minutes": self.spent(), "env_steps": self.num_timesteps, "rate": rate}
            started = time.perf_counter()
            self._report(row, self.model)
            self._started += time.perf_counter() - started
            if rate >= _GOAL:
                return False
        return self.spent() < self._minutes

    def spent(self) -> float:
        """Minutes of training and judging so far, those before it was gone on with included."""
        return (time.perf_counter() - self._started) / 60


class Keep:
    """Where a learner and its result wait to be gone on with."""

    def __init__(self, folder: pathlib.Path, name: str):
        self._folder = folder / name.replace(", ", "-").replace(" ", "-")

    def save(self, agent: BaseAlgorithm, result: dict[str, Any]) -> None:
        """Writes both; the one before counts until this is whole."""
        part = self._folder.with_suffix(".part")
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        agent.save(part / "agent.zip")
        agent.save_replay_buffer(part / "replay.pkl")
        (part / "result.json").write_text(json.dumps(result))
        shutil.rmtree(self._folder, ignore_errors=True)
        part.rename(self._folder)

    def load(self, agent: DQN) -> tuple[DQN, dict[str, Any] | None]:
        """The agent and its result as they were saved, or the agent that is given."""
        if not self._folder.is_dir():
            return agent, None
        agent = DQN.load(self._folder / "agent.zip", env=agent.get_env())
        agent.load_replay_buffer(self._folder / "replay.pkl")
        return agent, json.loads((self._folder / "result.json").read_text())


def their_time(
    name: str,
    config: TrainConfig,
    minutes: float,
    keep: Keep | None,
    write: Callable[[dict[str, Any]], None],
) -> None:
    """Trains one of theirs, and reports after every judgement."""
    make, averaged = LEARNERS[name]
    agent, before = make(config, config.total_steps), None
    if keep is not None:
        agent, before = keep.load(agent)
    result: dict[str, Any] = before or {
        "learner": name,
        "seed": config.seed,
        "episodes": config.select_episodes,
        "judged": [],
        "reached": None,
    }
    result["most_minutes"] = minutes
    if result["reached"]:
        write(result)
        return

    def report(row: dict[str, Any], agent: BaseAlgorithm) -> None:
        result["judged"].append(row)
        result["reached"] = row if row["rate"] >= _GOAL else None
        low, high = wilson_interval(
            round(row["rate"] * config.select_episodes), config.select_episodes
        )
        print(
            f"{name}: {row['minutes']:.1f} minutes, {row['env_steps']:,} steps, "
            f"{100 * row['rate']:.0f} % ({100 * low:.0f} to {100 * high:.0f})",
            flush=True,
        )
        write(result)
        if keep is not None:
            keep.save(agent, result)

    judging = Judging(
        Judge(config),
        every=config.select_every,
        minutes=minutes,
        averaged=averaged,
        before=result["judged"][-1] if result["judged"] else None,
        report=report,
    )
    left = config.total_steps - agent.num_timesteps
    agent.learn(left, callback=judging, log_interval=10**9, reset_num_timesteps=before is None)
    result["minutes"], result["env_steps"] = judging.spent(), agent.num_timesteps
    write(result)


def main() -> None:
    """Reads our run, trains theirs, and writes the results as they come."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "run",
        nargs="?",
        type=pathlib.Path,
        help="a run folder of ours; without one ours is what the file of results has",
    )
    parser.add_argument("--learners", nargs="+", choices=LEARNERS, default=list(LEARNERS))
    parser.add_argument("--minutes", type=float, help="5 times ours where left out")
    parser.add_argument("--threads", type=int, help="of PyTorch; all cores where left out")
    parser.add_argument("--keep", type=pathlib.Path, help="folder to save in and resume from")
    parser.add_argument("--json", type=pathlib.Path, help="file for the results")
    options = parser.parse_args()
    if options.threads:
        torch.set_num_threads(options.threads)
    about = machine() | {"torch": torch.__version__, "threads": torch.get_num_threads()}

    def read() -> dict[str, dict[str, Any]]:
        # Again each time: the other learner may be running beside this one, and so may ours.
        results = {}
        if options.json is not None and options.json.is_file():
            rows = json.loads(options.json.read_text())["results"]
            results = {row["learner"]: row for row in rows}
        if options.run is not None:
            results["mjx_arm"] = our_time(options.run) | {"machine": about}
        return results

    try:
        ours = read().get("mjx_arm")
        config = PRESETS["pixels"] if options.run is None else load_config(options.run)
    except ValueError as error:
        parser.error(str(error))
    if ours is None:
        parser.error("no run is given, and no file of results that has one: give a run folder")
    if options.minutes is None and ours["reached"] is None:
        parser.error(f"ours never reached {_GOAL:.0%}: give --minutes")
    minutes = options.minutes or 5 * ours["reached"]["minutes"]

    def write(result: dict[str, Any]) -> None:
        if options.json is None:
            return
        results = read() | {result["learner"]: result | {"machine": about}}
        report = {"goal": _GOAL, "results": list(results.values())}
        part = options.json.with_suffix(".part")
        part.write_text(json.dumps(report, indent=1) + "\n")
        part.replace(options.json)

    print(f"mjx_arm: {_GOAL:.0%} after {ours['reached'] and ours['reached']['minutes']} minutes")
    for name in options.learners:
        keep = Keep(options.keep, name) if options.keep else None
        their_time(name, config, minutes, keep, write)


if __name__ == "__main__":
    main()
