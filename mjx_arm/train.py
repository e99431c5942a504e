"""A training run from outside: chunks of the compiled loop, and what becomes of their results."""

from __future__ import annotations

import dataclasses
import json
import pathlib
import signal
import time
from types import FrameType, TracebackType
from typing import Self

import jax
from rich.console import Console

from mjx_arm.agent import load_agent, load_config, save_agent_params, save_config
from mjx_arm.checkpoint import RunCheckpoints
from mjx_arm.config import TrainConfig
from mjx_arm.evaluate import Evaluation, evaluate
from mjx_arm.loop import LoopState, Trainer, make_trainer, summarise
from mjx_arm.memory import check_memory, memory_plan
from mjx_arm.report.figures import plot_curves
from mjx_arm.report.metrics import MetricsWriter, keep_metrics
from mjx_arm.report.progress import describe, make_progress, say_device, say_memory
from mjx_arm.report.video import draw_episode, record_episode, write_video

# Held out: training draws its keys from the run's own seed.
_EVALUATION_SEED = 1_000_003
_EVALUATION_EPSILON = 0.1
# Chunks between two checkpoints.
_SAVE_EVERY = 10


class RunInterruptedError(Exception):
    """The user asked a run to stop; its state is saved."""


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
      RunInterruptedError: Ctrl-C.
    """
    trainer = _prepare(config, console)
    prepare_folder(folder)
    save_config(folder, config)
    _run(trainer, trainer.init(jax.random.key(config.seed)), 0, folder, console)
    return _finish(folder, eval_episodes, console)


def resume(
    folder: pathlib.Path,
    *,
    total_steps: int | None = None,
    eval_episodes: int,
    console: Console,
) -> Evaluation:
    """Goes on with a run from its newest checkpoint, as if it had never stopped.

    On the CPU, on the same machine and with as many threads, every bit is that of a run without the
    interruption; elsewhere counters and distributions go on.

    Args:
      folder: the run folder.
      total_steps: train for this long in all; by default as long as was planned.
      eval_episodes: episodes of the evaluation at the end.
      console: where it speaks.

    Raises:
      ValueError: the folder holds no run that can go on.
      RunInterruptedError: Ctrl-C.
    """
    config = load_config(folder)
    if total_steps is not None:
        config = dataclasses.replace(config, total_steps=total_steps)
    trainer = _prepare(config, console)
    like = jax.eval_shape(trainer.init, jax.random.key(config.seed))
    state, vector_step = RunCheckpoints(folder).load_newest(like)
    save_config(folder, config)
    keep_metrics(folder, vector_step * config.num_envs)
    console.print(f"going on after {vector_step * config.num_envs:,} steps")
    _run(trainer, state, vector_step // config.chunk_length, folder, console)
    return _finish(folder, eval_episodes, console)


def _prepare(config: TrainConfig, console: Console) -> Trainer:
    say_device(console)
    trainer = make_trainer(config)
    plan = memory_plan(jax.eval_shape(trainer.init, jax.random.key(config.seed)))
    say_memory(console, plan)
    check_memory(plan)
    return trainer


def _run(
    trainer: Trainer, state: LoopState, done: int, folder: pathlib.Path, console: Console
) -> None:
    config, checkpoints = trainer.config, RunCheckpoints(folder)
    per_chunk = config.chunk_length * config.num_envs
    chunks = -(-config.total_steps // per_chunk)
    console.print("compiling; the first chunk takes longer")
    with (
        _Interruption() as interruption,
        MetricsWriter(folder) as writer,
        make_progress(console) as progress,
    ):
        task = progress.add_task("", total=chunks * per_chunk, metrics="")
        for chunk in range(done + 1, chunks + 1):
            started = time.perf_counter()
            state, counts = trainer.run_chunk(state)
            metrics = summarise(config, jax.device_get(counts), chunk * config.chunk_length)
            metrics["steps_per_s"] = per_chunk / (time.perf_counter() - started)
            writer.write(metrics)
            progress.update(task, completed=chunk * per_chunk, metrics=describe(metrics))
            if chunk == chunks or chunk % _SAVE_EVERY == 0 or interruption.asked:
                checkpoints.save(chunk * config.chunk_length, state)
                save_agent_params(folder, state.learner.params)
            if interruption.asked and chunk < chunks:
                raise RunInterruptedError(f"saved; go on with: python train.py --resume {folder}")


class _Interruption:
    """Turns the first Ctrl-C into a wish to stop after the chunk; the second one stops at once."""

    def __init__(self) -> None:
        self.asked = False

    def __enter__(self) -> Self:
        self._before = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        signal.signal(signal.SIGINT, self._before)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True


def _finish(folder: pathlib.Path, eval_episodes: int, console: Console) -> Evaluation:
    for path in plot_curves(folder):
        console.print(f"curves: {path}")
    agent = load_agent(folder)
    result = evaluate(
        agent.env,
        agent.dqn.apply,
        agent.params,
        episodes=eval_episodes,
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
