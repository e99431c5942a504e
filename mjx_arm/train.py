"""A training run from outside: chunks of the compiled loop, and what becomes of their results."""

from __future__ import annotations

import dataclasses
import json
import pathlib
import time

import jax
from rich.console import Console

from mjx_arm.agent import load_agent, save_agent_params, save_config
from mjx_arm.config import TrainConfig
from mjx_arm.evaluate import Evaluation, evaluate
from mjx_arm.loop import Trainer, make_trainer, summarise
from mjx_arm.memory import check_memory, memory_plan
from mjx_arm.report.figures import plot_curves
from mjx_arm.report.metrics import MetricsWriter
from mjx_arm.report.progress import describe, make_progress, say_device, say_memory
from mjx_arm.report.video import draw_episode, record_episode, write_video

# Held out: training draws its keys from the run's own seed.
_EVALUATION_SEED = 1_000_003
_EVALUATION_EPSILON = 0.1
# Chunks between two checkpoints of the parameters.
_SAVE_EVERY = 10


def train(
    config: TrainConfig, folder: pathlib.Path, *, eval_episodes: int, console: Console
) -> Evaluation:
    """Trains an agent and leaves metrics, curves, parameters, an evaluation and a video.

    Args:
      config: the options.
      folder: the run folder; made, must be new or empty.
      eval_episodes: episodes of the evaluation at the end.
      console: where it speaks.

    Returns:
      The evaluation.

    Raises:
      ValueError: the options do not fit the machine, or the folder cannot be used.
    """
    say_device(console)
    trainer = make_trainer(config)
    plan = memory_plan(jax.eval_shape(trainer.init, jax.random.key(config.seed)))
    say_memory(console, plan)
    check_memory(plan)
    prepare_folder(folder)
    save_config(folder, config)
    _run(trainer, folder, console)
    for path in plot_curves(folder):
        console.print(f"curves: {path}")
    return _show_agent(folder, eval_episodes, console)


def _run(trainer: Trainer, folder: pathlib.Path, console: Console) -> None:
    config = trainer.config
    state = trainer.init(jax.random.key(config.seed))
    per_chunk = config.chunk_length * config.num_envs
    chunks = -(-config.total_steps // per_chunk)
    console.print("compiling; the first chunk takes longer")
    with MetricsWriter(folder) as writer, make_progress(console) as progress:
        task = progress.add_task("", total=chunks * per_chunk, metrics="")
        for chunk in range(1, chunks + 1):
            started = time.perf_counter()
            state, counts = trainer.run_chunk(state)
            metrics = summarise(config, jax.device_get(counts), chunk * config.chunk_length)
            metrics["steps_per_s"] = per_chunk / (time.perf_counter() - started)
            writer.write(metrics)
            progress.update(task, completed=chunk * per_chunk, metrics=describe(metrics))
            if chunk == chunks or chunk % _SAVE_EVERY == 0:
                save_agent_params(folder, state.learner.params)


def _show_agent(folder: pathlib.Path, episodes: int, console: Console) -> Evaluation:
    agent = load_agent(folder)
    result = evaluate(
        agent.env,
        agent.dqn.apply,
        agent.params,
        episodes=episodes,
        epsilon=_EVALUATION_EPSILON,
        seed=_EVALUATION_SEED,
    )
    (folder / "evaluation.json").write_text(json.dumps(dataclasses.asdict(result)) + "\n")
    low, high = result.ci95
    console.print(
        f"evaluation: {result.successes} of {result.episodes} episodes succeeded, "
        f"{100 * result.rate:.1f} % (95 % interval {100 * low:.1f} to {100 * high:.1f}), "
        f"the cube was grasped in {100 * result.grasp_rate:.0f} %"
    )
    episode = record_episode(
        agent.env,
        agent.dqn.apply,
        agent.params,
        epsilon=_EVALUATION_EPSILON,
        seed=_EVALUATION_SEED,
    )
    path = folder / "policy.mp4"
    write_video(path, draw_episode(agent.env, episode))
    console.print(f"video: {path} ({len(episode.qpos)} frames, success: {episode.success})")
    return result


def prepare_folder(folder: pathlib.Path) -> None:
    """Makes the run folder.

    Raises:
      ValueError: it is a file, holds something already, or cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        occupied = any(folder.iterdir())
    except (FileExistsError, NotADirectoryError) as error:
        raise ValueError(f"{folder} is a file: give --out a new or empty folder") from error
    except PermissionError as error:
        raise ValueError(f"{folder} cannot be written: give --out another folder") from error
    if occupied:
        raise ValueError(f"{folder} is not empty: give --out a new or empty folder")
