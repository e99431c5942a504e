"""A training run from outside: chunks of the compiled loop, and what becomes of their results."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import json
import math
import os
import pathlib
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterator
from types import FrameType, TracebackType
from typing import Any, Self

import jax
from rich.console import Console

from mjx_arm.agent import (
    BEST,
    CONFIG,
    LAST,
    evaluation_env,
    find_agent,
    load_agent,
    load_config,
    read_selection_rate,
    save_agent,
    save_config,
)
from mjx_arm.checkpoint import RunCheckpoints
from mjx_arm.config import TrainConfig
from mjx_arm.evaluate import Evaluation, evaluate, make_evaluator
from mjx_arm.loop import Counts, LoopState, Trainer, make_trainer, run_keys, summarise
from mjx_arm.memory import check_memory, memory_plan, working_memory
from mjx_arm.report.figures import plot_curves
from mjx_arm.report.metrics import MetricsWriter, keep_metrics, last_env_steps, last_wall_s
from mjx_arm.report.progress import (
    describe,
    make_progress,
    say_device,
    say_memory,
    say_working_memory,
)
from mjx_arm.report.video import draw_episode, record_episode, write_video

# Held out: training draws its keys from the run's own seed, and what selects an agent does not
# judge it.
_SELECTION_SEED = 2_000_003
_EVALUATION_SEED = 1_000_003
_EVALUATION_EPSILON = 0.1
_EVALUATION = "evaluation.json"
Evaluate = Callable[[Any, int], Evaluation]
RunChunk = Callable[[LoopState], tuple[LoopState, Counts]]
# Chunks between two checkpoints.
_SAVE_EVERY = 10


class RunInterruptedError(Exception):
    """The user asked a run to stop; its state is saved."""


def train(
    config: TrainConfig, folder: pathlib.Path | None, *, eval_episodes: int, console: Console
) -> list[Evaluation]:
    """Trains an agent and leaves metrics, curves, agents, an evaluation and a video.

    With several seeds each has all this in a folder of its own, `seed-0` and so on.

    Args:
      config: the options.
      folder: the run folder; made, must be new or empty. None for a new one in `runs`, named by
        the time.
      eval_episodes: episodes of the evaluation at the end.
      console: where it speaks.

    Returns:
      The evaluation of each seed.

    Raises:
      ValueError: the options do not fit the machine, or the folder cannot be used.
      RunInterruptedError: Ctrl-C.
    """
    _check_episodes(eval_episodes)
    trainer = _prepare(config, console)
    folder = new_run_folder(config.env) if folder is None else prepare_folder(folder)
    run_chunk = _compile(trainer, console)
    # With the backend by name: where a run goes on, "auto" may mean another, with other states.
    config = dataclasses.replace(config, physics=trainer.env.physics.backend)
    _save_configs(folder, config)
    _run(trainer, run_chunk, trainer.init(run_keys(config)), 0, folder, console)
    return _finish(folder, config, eval_episodes, console)


def resume(
    folder: pathlib.Path,
    *,
    total_steps: int | None = None,
    eval_episodes: int,
    console: Console,
) -> list[Evaluation]:
    """Goes on with a run from its newest checkpoint, as if it had never stopped.

    On the CPU, on the same machine and with as many threads, every bit is that of a run without the
    interruption; elsewhere counters and distributions go on.

    Args:
      folder: the run folder.
      total_steps: train for this long in all, longer than until now; by default as long as was
        planned. The selection that ended a shorter run is kept.
      eval_episodes: episodes of the evaluation at the end.
      console: where it speaks.

    Raises:
      ValueError: the folder holds no run that can go on.
      RunInterruptedError: Ctrl-C.
    """
    _check_episodes(eval_episodes)
    _check_whole_run(folder)
    saved = config = load_config(folder)
    if total_steps is not None:
        config = dataclasses.replace(config, total_steps=total_steps)
    trainer = _prepare(config, console)
    checkpoints = RunCheckpoints(folder)
    saved_any = _has_saved(trainer, folder)
    vector_step = checkpoints.find_newest(_shapes(trainer)) if saved_any else 0
    if config.total_steps < min(vector_step * config.num_envs, saved.total_steps):
        raise ValueError(
            f"--total-steps is {total_steps}: the run has made "
            f"{vector_step * config.num_envs} already, give more"
        )
    # Before the state is held, or its memory would count as needed and as taken.
    run_chunk = _compile(trainer, console)
    if saved_any:
        state = checkpoints.load(vector_step, _shapes(trainer))
    else:
        state = trainer.init(run_keys(config))
    if config != saved:
        _save_configs(folder, config)
    for seed_folder in seed_folders(folder, config):
        keep_metrics(seed_folder, vector_step * config.num_envs)
    console.print(f"going on after {vector_step * config.num_envs:,} steps")
    _run(trainer, run_chunk, state, vector_step // config.chunk_length, folder, console)
    return _finish(folder, config, eval_episodes, console)


def _check_episodes(eval_episodes: int) -> None:
    if eval_episodes < 1:
        raise ValueError(f"eval_episodes is {eval_episodes}: give at least 1")


def _check_whole_run(folder: pathlib.Path) -> None:
    """Refuses the folder of one seed of several, whose checkpoints are those of all."""
    parent = folder.resolve().parent
    if not (parent / CONFIG).is_file():
        return
    seeds = seed_folders(parent, load_config(parent))
    if len(seeds) > 1 and folder.resolve() in seeds:
        raise ValueError(f"{folder} is one seed of several: give the folder of all, {parent}")


def _has_saved(trainer: Trainer, folder: pathlib.Path) -> bool:
    """Whether a run got as far as its first checkpoint; that may be its last."""
    config = trainer.config
    unsaved = _SAVE_EVERY * config.chunk_length * config.num_envs
    first = seed_folders(folder, config)[0]
    ended = (first / _EVALUATION).is_file()
    return ended or RunCheckpoints(folder).newest() is not None or last_env_steps(first) > unsaved


def _prepare(config: TrainConfig, console: Console) -> Trainer:
    say_device(console)
    trainer = make_trainer(config)
    plan = memory_plan(_shapes(trainer))
    say_memory(console, plan)
    check_memory(plan)
    return trainer


def _shapes(trainer: Trainer) -> LoopState:
    return jax.eval_shape(trainer.init, run_keys(trainer.config))


def _compile(trainer: Trainer, console: Console) -> RunChunk:
    """The compiled chunk; refused where what it needs to work in does not fit beside the state."""
    console.print("compiling")
    shapes = _shapes(trainer)
    compiled = trainer.run_chunk.lower(shapes).compile()
    simulations = trainer.config.num_seeds * trainer.config.num_envs
    working = working_memory(compiled, trainer.env.physics, simulations)
    plan = memory_plan(shapes) | {"working": working}
    say_working_memory(console, plan)
    check_memory(plan)
    return compiled


def seed_folders(folder: pathlib.Path, config: TrainConfig) -> list[pathlib.Path]:
    """Where the results of each seed go."""
    if config.num_seeds == 1:
        return [folder]
    return [folder / f"seed-{config.seed + i}" for i in range(config.num_seeds)]


def _seed_configs(config: TrainConfig) -> list[TrainConfig]:
    """The configuration of each seed's own run."""
    return [
        dataclasses.replace(config, seed=config.seed + i, num_seeds=1)
        for i in range(config.num_seeds)
    ]


def _save_configs(folder: pathlib.Path, config: TrainConfig) -> None:
    if config.num_seeds > 1:
        pairs = zip(seed_folders(folder, config), _seed_configs(config), strict=True)
        for seed_folder, seed_config in pairs:
            seed_folder.mkdir(exist_ok=True)
            save_config(seed_folder, seed_config)
    # Last: what has this can go on.
    save_config(folder, config)


def _of_seed(tree: Any, config: TrainConfig, i: int) -> Any:
    return tree if config.num_seeds == 1 else jax.tree.map(lambda x: x[i], tree)


class _Results:
    """What the chunks of one seed leave on disk: metrics, the last agent, and the best one."""

    def __init__(
        self, folder: pathlib.Path, config: TrainConfig, evaluate_params: Evaluate, started: float
    ):
        self.folder, self.config = folder, config
        self._evaluate = evaluate_params
        self._best = read_selection_rate(folder / BEST)
        self._wall_before = last_wall_s(folder)
        self._started = started
        self.writer = MetricsWriter(folder)

    def add(
        self, counts: Counts, params: Any, chunk: int, *, seconds: float, select: bool
    ) -> dict[str, float]:
        """Writes the metrics of a chunk, the selection's included, and returns them."""
        metrics = summarise(self.config, counts, chunk * self.config.chunk_length)
        per_chunk = self.config.chunk_length * self.config.num_envs
        metrics["steps_per_s"] = per_chunk / seconds
        metrics["selection_rate"] = math.nan
        if select:
            metrics["selection_rate"] = self._select(params, int(metrics["env_steps"]))
        metrics["wall_s"] = self._wall_before + time.perf_counter() - self._started
        self.writer.write(metrics)
        return metrics

    def _select(self, params: Any, env_steps: int) -> float:
        rate = self._evaluate(params, _SELECTION_SEED).rate
        # The later of two equal ones: it has seen more.
        if self._best is None or rate >= self._best:
            self._best = rate
            self._save(BEST, params, env_steps, rate)
        return rate

    def save_last(self, params: Any, env_steps: int) -> None:
        self._save(LAST, params, env_steps, None)

    def _save(self, name: str, params: Any, env_steps: int, rate: float | None) -> None:
        path = self.folder / name
        save_agent(path, self.config, params, env_steps=env_steps, selection_rate=rate)


def _run(
    trainer: Trainer,
    run_chunk: RunChunk,
    state: LoopState,
    done: int,
    folder: pathlib.Path,
    console: Console,
) -> None:
    config, checkpoints, started = trainer.config, RunCheckpoints(folder), time.perf_counter()
    per_chunk = config.chunk_length * config.num_envs
    chunks = config.num_chunks
    evaluate_params = make_evaluator(
        evaluation_env(config),
        trainer.dqn.apply,
        episodes=config.select_episodes,
        epsilon=_EVALUATION_EPSILON,
    )
    with contextlib.ExitStack() as stack:
        stack.enter_context(_offering(checkpoints))
        interruption = stack.enter_context(_Interruption())
        progress = stack.enter_context(make_progress(console))
        pairs = zip(seed_folders(folder, config), _seed_configs(config), strict=True)
        results = [_Results(*pair, evaluate_params, started) for pair in pairs]
        for result in results:
            stack.enter_context(result.writer)
        task = progress.add_task("", total=chunks * per_chunk, metrics="")
        for chunk in range(done + 1, chunks + 1):
            before = time.perf_counter()
            state, counts = run_chunk(state)
            counts = jax.device_get(counts)
            seconds = time.perf_counter() - before
            last = chunk == chunks
            select = config.select_every > 0 and (last or _is_due(config, chunk))
            policy = trainer.dqn.policy(state.learner)
            params = [_of_seed(policy, config, i) for i in range(len(results))]
            rows = [
                result.add(
                    _of_seed(counts, config, i), params[i], chunk, seconds=seconds, select=select
                )
                for i, result in enumerate(results)
            ]
            progress.update(task, completed=chunk * per_chunk, metrics=describe(rows))
            if last or chunk % _SAVE_EVERY == 0 or interruption.asked:
                # The checkpoint last: what is older than it would not be made again.
                for result, own in zip(results, params, strict=True):
                    result.save_last(own, chunk * per_chunk)
                checkpoints.save(chunk * config.chunk_length, state)
            if interruption.asked and not last:
                command = f"{sys.executable} -m mjx_arm train --resume {shlex.quote(str(folder))}"
                raise RunInterruptedError(f"saved; go on with: {command}")


@contextlib.contextmanager
def _offering(checkpoints: RunCheckpoints) -> Iterator[None]:
    """Adds to what could not be written the checkpoint to go on from, in one sentence."""
    try:
        yield
    except (OSError, ValueError) as error:
        said = str(error)
        if isinstance(error, OSError):
            said = f"{error.filename or checkpoints.folder}: {error.strerror or error}"
        newest = checkpoints.newest()
        offer = f"; --resume goes on from {newest}, which is whole" if newest else ""
        raise ValueError(f"{said}{offer}") from error


def _is_due(config: TrainConfig, chunk: int) -> bool:
    """Whether a selection falls into this chunk."""
    per_chunk = config.chunk_length * config.num_envs
    return chunk * per_chunk // config.select_every > (chunk - 1) * per_chunk // config.select_every


class _Interruption:
    """Turns the first Ctrl-C into a wish to stop after the chunk; the second one is as before."""

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
        if self.asked and callable(self._before):
            self._before(number, frame)
        self.asked = True


def _finish(
    folder: pathlib.Path, config: TrainConfig, eval_episodes: int, console: Console
) -> list[Evaluation]:
    folders = seed_folders(folder, config)
    if len(folders) > 1:
        for path in plot_curves(folders, into=folder):
            console.print(f"curves: {path}")
    return [_finish_seed(own, eval_episodes, console) for own in folders]


def _finish_seed(folder: pathlib.Path, eval_episodes: int, console: Console) -> Evaluation:
    for path in plot_curves([folder], into=folder):
        console.print(f"curves: {path}")
    agent = load_agent(folder)
    console.print(f"agent: {find_agent(folder)}, after {agent.env_steps:,} steps")
    result = evaluate(
        agent.env,
        agent.dqn.apply,
        agent.params,
        episodes=eval_episodes,
        epsilon=_EVALUATION_EPSILON,
        seed=_EVALUATION_SEED,
    )
    (folder / _EVALUATION).write_text(json.dumps(dataclasses.asdict(result)) + "\n")
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


def new_run_folder(env: str) -> pathlib.Path:
    """Makes a folder in `runs`, named by the time, and with a number where that name is taken.

    Raises:
      ValueError: it cannot be made.
    """
    runs, name = pathlib.Path("runs"), f"{datetime.datetime.now():%Y-%m-%d-%H%M%S}-{env}"
    folder, number = runs / name, 1
    try:
        runs.mkdir(exist_ok=True)
        while True:
            # Not `exist_ok`: runs that a cluster starts in one second must not share a folder.
            with contextlib.suppress(FileExistsError):
                folder.mkdir()
                return folder
            number += 1
            folder = runs / f"{name}-{number}"
    except OSError as error:
        raise _cannot_be_made(folder, error) from error


def _cannot_be_made(folder: pathlib.Path, error: OSError) -> ValueError:
    return ValueError(f"{folder} cannot be made ({error.strerror}): give --out another folder")


def prepare_folder(folder: pathlib.Path) -> pathlib.Path:
    """Makes the run folder, and returns it.

    Raises:
      ValueError: it is a file, holds something already, or cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        occupied = any(folder.iterdir())
    except (FileExistsError, NotADirectoryError) as error:
        raise ValueError(f"{folder} is a file: give --out a new or empty folder") from error
    except OSError as error:
        raise _cannot_be_made(folder, error) from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ValueError(f"{folder} cannot be written: give --out another folder")
    if occupied:
        raise ValueError(f"{folder} is not empty: give --out a new or empty folder")
    return folder
