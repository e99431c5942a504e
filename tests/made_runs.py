"""Run folders made without training: a configuration, metrics and an evaluation."""

from __future__ import annotations

import json
import pathlib
from typing import Any

from mjx_arm.config import TrainConfig, train_config
from mjx_arm.scene import load_scene
from mjx_arm.training.evaluate import wilson_interval
from mjx_arm.training.run_folder import SavedRun, save_run, seed_folders


def row(step: int, *, rate: float | None) -> dict[str, Any]:
    """The metrics of a chunk."""
    return {
        "env_steps": step,
        "episodes": 10.0,
        "successes": 5.0,
        "success_rate": 0.5,
        "mean_length": 40.0,
        "mean_reward": 0.25,
        "mean_max_q": 2.0,
        "blocked_share": 0.0,
        "mean_distance": 0.1,
        "grasped_share": 0.3,
        "loss": 0.02,
        "epsilon": 0.1,
        "steps_per_s": 1000.0,
        "selection_rate": rate,
        "wall_s": step / 1000,
    }


def make_run(
    folder: pathlib.Path,
    successes: tuple[int, ...] = (90,),
    *,
    episodes: int = 100,
    selections: tuple[float | None, ...] = (None, 0.4, None, 0.6, None, 0.95),
    **options: Any,
) -> TrainConfig:
    """Makes a run folder with one seed for each of `successes`."""
    config = train_config(num_seeds=len(successes), **options)
    folder.mkdir()
    save_run(folder, SavedRun(config, {}, load_scene("arm_cube").source))
    for own, count in zip(seed_folders(folder, config), successes, strict=True):
        rows = [row(10_000 * (i + 1), rate=rate) for i, rate in enumerate(selections)]
        (own / "metrics.jsonl").write_text("".join(json.dumps(each) + "\n" for each in rows))
        evaluation = {
            "episodes": episodes,
            "successes": count,
            "rate": count / episodes,
            "ci95": wilson_interval(count, episodes),
            "mean_length": 120.0,
            "metrics": {"grasped_rate": 0.99, "grasped_failed_rate": 0.05, "grasped_again": 0.8},
        }
        (own / "evaluation.json").write_text(json.dumps(evaluation))
    return config
