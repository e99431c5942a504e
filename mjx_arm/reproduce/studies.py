"""Measurements of the runs of the studies: the reward, the preset `paper`, the ablations."""

from __future__ import annotations

import pathlib
from typing import Any

from mjx_arm.envs.env import make_env
from mjx_arm.report.run_page import read_evaluation
from mjx_arm.reproduce.curves import read_curve
from mjx_arm.reproduce.trials import Result, Trial, measure_episodes
from mjx_arm.training.agent import LAST
from mjx_arm.training.run_folder import load_config

# Of an evaluation, what the page has a use for.
_OF_EVALUATION = ("episodes", "successes", "rate", "ci95", "mean_length", "metrics")


def measure_reward(name: str, run: pathlib.Path, trial: Trial) -> Result:
    """A run of the reward study: its curve, and of its last agent the success and the heights.

    Args:
      name: of the cell.
      run: the run folder.
      trial: how the policy is tried.

    Returns:
      Also `worth`, the value of hovering just below the goal for ever and that of success, at the
      run's discount: the calculation that the study checks.
    """
    config = load_config(run)
    result, _ = measure_episodes(name, str(run / LAST), trial, pictures=False)
    # Starts are of no interest here, and are most of the file.
    result.pop("episodes_each")
    env = make_env(config.env)
    options: Any = env.config.task_options
    task: Any = env.task
    if config.env.reward == "paper":
        hovering = 1 + (options.lift + task.half_size) / options.height_unit
    else:
        hovering = options.completion_grasp + options.completion_lift
    success = options.success_reward
    if config.env.reward == "shaped":
        # Hovering has been paid for when the cube came there, and success takes that back.
        success -= hovering / (1 - options.shaping_discount)
        hovering = 0.0
    result |= {
        "reward": config.env.reward,
        "gamma": config.algo.gamma,
        "train_seed": config.seed,
        "reward_scale": config.env.reward_scale,
        "worth": {
            "a_step_of_hovering": hovering,
            "hovering_for_ever": hovering / (1 - config.algo.gamma),
            "success": success,
        },
        "curve": read_curve(run, config.env.reward_scale),
    }
    return result, {}


def measure_paper(name: str, run: pathlib.Path, trials: dict[str, Trial]) -> Result:
    """The preset `paper`: its curve, and the success of its last agent under several trials."""
    config = load_config(run)
    result: dict[str, Any] = {"curve": read_curve(run, config.env.reward_scale), "trials": {}}
    for label, trial in trials.items():
        found, _ = measure_episodes(name, str(run / LAST), trial, pictures=False)
        found.pop("episodes_each")
        result["trials"][label] = found
    return result, {}


def measure_ablation(run: pathlib.Path) -> Result:
    """A run of the ablations: the evaluation at its end, its curve and its time.

    Raises:
      ValueError: the run has not been evaluated.
    """
    config, evaluation = load_config(run), read_evaluation(run)
    if evaluation is None:
        raise ValueError(f"{run} has not been evaluated: continue it")
    curve = read_curve(run, config.env.reward_scale)
    return {
        **{name: evaluation[name] for name in _OF_EVALUATION},
        "env_steps": curve["env_steps"][-1],
        "wall_s": curve["wall_s"],
        "selections": curve["selections"],
        "seed": config.seed,
    }, {}
