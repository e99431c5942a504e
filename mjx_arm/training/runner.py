"""A training run from outside: chunks of the compiled loop, and what becomes of their results."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import math
import os
import pathlib
import shlex
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType, TracebackType
from typing import Any, ParamSpec, Self, TypeVar

import flax.traverse_util
import jax
import jax.numpy as jnp
from rich.console import Console

from mjx_arm.algos.collect import Counts
from mjx_arm.config import TrainConfig, advice, set_train_options
from mjx_arm.devices import check_device
from mjx_arm.envs.env import make_env
from mjx_arm.envs.tasks import find_task
from mjx_arm.options import Count, Discount, Positive, check_value, flat_names, get_option
from mjx_arm.report.figures import plot_curves
from mjx_arm.report.machine import versions
from mjx_arm.report.metrics import MetricsWriter, keep_metrics, last_env_steps, last_wall_s
from mjx_arm.report.progress import (
    RunProgress,
    make_console,
    phase,
    say_device,
    say_memory,
    say_mesh,
    say_working_memory,
)
from mjx_arm.report.run_page import write_report
from mjx_arm.report.video import record_episode, render_episode, write_video
from mjx_arm.scene import Scene, compile_scene, read_source, scene_exists
from mjx_arm.training.agent import (
    BEST,
    LAST,
    STORED,
    add_evaluation,
    check_tensors,
    evaluation_config,
    find_agent,
    flatten_params,
    load_agent,
    read_agent,
    read_selection_rate,
    save_agent,
)
from mjx_arm.training.checkpoint import RunCheckpoints
from mjx_arm.training.evaluate import Evaluation, evaluate, make_evaluator
from mjx_arm.training.loop import (
    EVALUATION as EVALUATION_ROLE,
)
from mjx_arm.training.loop import (
    SELECTION,
    LoopState,
    Trainer,
    check_takes_shard,
    make_trainer,
    role_key,
    summarise,
)
from mjx_arm.training.memory import check_memory, memory_plan, working_memory
from mjx_arm.training.mesh import (
    check_division,
    fetch,
    make_mesh,
    most_devices,
    place,
    shards_seeds,
)
from mjx_arm.training.objects import Objects, Record, check_record, only_here, record
from mjx_arm.training.processes import (
    any_says,
    check_same,
    is_writer,
    on_writer,
    processes_here,
    wait_for_all,
    watching_others,
)
from mjx_arm.training.run_folder import (
    EVALUATION,
    SavedRun,
    check_folder,
    check_untouched,
    choose_run_folder,
    load_run,
    locked,
    new_run_folder,
    of_seed,
    prepare_folder,
    save_run,
    seed_configs,
    seed_folders,
)

# Held out: their keys have roles of their own, so no seed of a training meets them.
_SELECTION_SEED = 2_000_003
_EVALUATION_SEED = 1_000_003
_EVALUATION_EPSILON = 0.1
P = ParamSpec("P")
R = TypeVar("R")
Evaluate = Callable[[Any], Evaluation]
RunChunk = Callable[[LoopState], tuple[LoopState, Counts]]
# Called between two chunks with the metrics of each seed and the state.
OnChunk = Callable[[list[dict[str, float]], LoopState], None]
# Chunks between two checkpoints.
_SAVE_EVERY = 10
_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1")


def stop_signals() -> list[int]:
    """The signals that ask a run to stop, without a hangup that `nohup` lets it ignore."""
    numbers = [getattr(signal, name) for name in _SIGNALS if hasattr(signal, name)]
    ignored = {
        number
        for number in numbers
        if number != signal.SIGINT and signal.getsignal(number) == signal.SIG_IGN
    }
    return [number for number in numbers if number not in ignored]


class RunInterruptedError(Exception):
    """The user asked a run to stop; its state is saved."""


def _as_run(function: Callable[P, R]) -> Callable[P, R]:
    """Allows rank promotion, and ends where another process of the run is lost.

    JAX_NUMPY_RANK_PROMOTION is meant for the user's own programs.
    """

    @functools.wraps(function)
    def run(*args: P.args, **options: P.kwargs) -> R:
        with jax.numpy_rank_promotion("allow"), watching_others():
            return function(*args, **options)

    return run


@_as_run
def train(
    config: TrainConfig,
    folder: str | pathlib.Path | None = None,
    *,
    preset: str | None = None,
    eval_episodes: int = 200,
    stop_at: float | None = None,
    minutes: float | None = None,
    init_from: str | pathlib.Path | None = None,
    devices: int | None = None,
    on_chunk: OnChunk | None = None,
    video: bool = True,
    console: Console | None = None,
    env: Any = None,
    network: Any = None,
    reward: Any = None,
    algorithm: Any = None,
) -> list[Evaluation]:
    """Trains an agent and leaves metrics, curves, agents, an evaluation and a video.

    With several seeds each has all this in a folder of its own, `seed-0` and so on. With several
    processes (`jax.distributed`) each must call this; process 0 writes.

    Args:
      config: the options.
      folder: the run folder; made, must be new or empty. None for a new one in `runs`, named by
        the time.
      preset: name of the preset that the options come from, which is then printed.
      eval_episodes: episodes of the evaluation at the end.
      stop_at: end the run when a selection has reached this success rate for every seed.
      minutes: end the run after the first chunk that ends later than this; compiling and the
        evaluation at the end are not counted.
      init_from: an agent whose network the run starts from.
      devices: number of local devices that share the work, as `make_trainer` says; by default as
        many as divide it. 1 is the program for one device.
      on_chunk: called after each chunk with the metrics of each seed and the state, which it may
        read until it returns.
      video: record an episode at the end.
      console: where it prints; by default the terminal.
      env: an environment of one's own.
      network: a Flax module `observations [B, ...] -> Q-values [B, A]` of one's own.
      reward: a function `(before, after, action) -> terms` of one's own; see `mjx_arm.make`.
      algorithm: makes an algorithm of one's own; see `make_trainer`.

    Returns:
      The evaluation of each seed.

    Raises:
      ValueError: the options do not fit the machine, or the folder cannot be used.
      RunInterruptedError: Ctrl-C, SIGTERM, SIGHUP or SIGUSR1.
    """
    _check_options(eval_episodes, stop_at, minutes)
    console = _own_console(console)
    objects = Objects(env=env, network=network, reward=reward, algorithm=algorithm)
    name = config.env.env if env is None else env.config.env
    chosen = pathlib.Path(on_writer(lambda: str(_choose_folder(name, folder))))
    console.print(f"run folder: {chosen}", soft_wrap=True)
    if preset is not None:
        console.print(f"preset: {preset}")
    _check_selects(config, stop_at)
    trainer = _prepare(config, objects, console, devices)
    config = trainer.config
    recorded = record(config, objects)
    ends = {"eval_episodes": eval_episodes, "stop_at": stop_at, "minutes": minutes}
    _check_same_run(trainer, recorded, {"run": "a new one", "init_from": init_from} | ends)
    for sentence in only_here(recorded):
        console.print(f"[yellow]warning: {sentence}[/yellow]", soft_wrap=True)
    start = None if init_from is None else _read_policy(trainer, pathlib.Path(init_from))
    made = pathlib.Path(on_writer(lambda: str(_make_folder(name, folder, chosen))))
    if made != chosen:
        console.print(f"run folder: {made}; another run has taken {chosen}", soft_wrap=True)
    with _locked(made):
        run_chunk = _compile(trainer, console)
        with phase(console, "starting the environments"):
            state = trainer.start()
        if start is not None:
            learner = trainer.algorithm.with_policy(state.learner, start)
            state = place(dataclasses.replace(state, learner=learner), trainer.shapes())
        run = SavedRun(_with_backend(config, trainer), recorded, trainer.env.scene.source)
        on_writer(lambda: save_run(made, run))
        if start is not None:
            # Or a run that is killed before its first checkpoint would begin with a new network.
            RunCheckpoints(made, run.origin).save(0, state)
        loop = _Loop(trainer, run, run_chunk, made, console, stop_at, minutes, on_chunk)
        console.print(f"training: {config.total_steps:,} environment steps")
        loop.run(state, 0)
        ending = _Ending(eval_episodes, console, _local_devices(trainer), video)
        return _finish_on_writer(made, run, objects, ending)


@_as_run
def resume(
    folder: str | pathlib.Path,
    *,
    total_steps: int | None = None,
    eval_episodes: int = 200,
    stop_at: float | None = None,
    minutes: float | None = None,
    devices: int | None = None,
    on_chunk: OnChunk | None = None,
    video: bool = True,
    console: Console | None = None,
    env: Any = None,
    network: Any = None,
    reward: Any = None,
    algorithm: Any = None,
) -> list[Evaluation]:
    """Continues a run from its newest checkpoint, as if it had never stopped.

    Resuming is bit-exact on the same CPU with the same number of threads, devices and processes. On
    other hardware, or with another number of them, the run continues, but not bit for bit.

    Args:
      folder: the run folder.
      total_steps: environment steps of the whole run, more than before; by default as planned. The
        selection that ended a shorter run is kept.
      eval_episodes: episodes of the evaluation at the end.
      stop_at: end the run when a selection has reached this success rate for every seed.
      minutes: see `train`; those before it was stopped count.
      devices: see `train`.
      on_chunk: see `train`.
      video: record an episode at the end.
      console: where it prints.
      env: the environment, if the run was started with one.
      network: the same for the network.
      reward: the same for the reward.
      algorithm: the same for the algorithm.

    Raises:
      ValueError: the folder holds no run that can be continued, or an object is not the run's.
      RunInterruptedError: Ctrl-C, SIGTERM, SIGHUP or SIGUSR1.
    """
    _check_options(eval_episodes, stop_at, minutes)
    folder = pathlib.Path(folder)
    console = _own_console(console)
    _check_whole_run(folder)
    saved = load_run(folder)
    check_untouched(folder, saved)
    for own in seed_folders(folder, saved.config):
        last_env_steps(own)  # damaged metrics are found before anything is compiled
    objects = Objects(env=env, network=network, reward=reward, algorithm=algorithm)
    check_record(saved.objects, saved.config, objects, str(folder))
    scene = _scene_of(folder, saved, objects)
    config = saved.config
    if total_steps is not None:
        config = dataclasses.replace(config, total_steps=total_steps)
    _check_selects(config, stop_at)
    with _locked(folder):
        console.print(f"run folder: {folder}", soft_wrap=True)
        trainer = _prepare(config, objects, console, devices, scene)
        ends = {"eval_episodes": eval_episodes, "stop_at": stop_at, "minutes": minutes}
        _check_same_run(trainer, saved.objects, {"run": saved.run_id, "init_from": None} | ends)
        _check_same_env(config, _with_backend(trainer.config, trainer), folder)
        checkpoints = RunCheckpoints(folder, saved.origin)
        shapes = trainer.shapes()
        found = on_writer(lambda: _newest_step(trainer, folder, checkpoints, shapes))
        vector_step = int(found or 0)
        done = vector_step * config.num_envs
        if config.total_steps < min(done, saved.config.total_steps):
            raise ValueError(
                f"--total-steps must be at least {done}, which the run has made already, "
                f"got {total_steps}"
            )
        # Before the state is allocated, or the memory check would count it twice.
        run_chunk = _compile(trainer, console)
        with phase(console, "reading the checkpoint" if found else "starting the environments"):
            state = checkpoints.load(vector_step, shapes) if found else trainer.start()
        run = dataclasses.replace(saved, config=config)
        on_writer(lambda: _continue_files(folder, run, saved, done))
        console.print(f"resuming after {done:,} steps")
        loop = _Loop(trainer, run, run_chunk, folder, console, stop_at, minutes, on_chunk)
        loop.run(state, vector_step // config.chunk_length)
        ending = _Ending(eval_episodes, console, _local_devices(trainer), video)
        return _finish_on_writer(folder, run, objects, ending)


def _own_console(console: Console | None) -> Console:
    """The console of the process that writes; the others print nothing."""
    if not is_writer():
        return Console(quiet=True)
    return make_console() if console is None else console


def _choose_folder(name: str, folder: str | pathlib.Path | None) -> pathlib.Path:
    """The path of the run folder, which nobody has made yet."""
    if folder is None:
        return choose_run_folder(name)
    check_folder(pathlib.Path(folder))
    return pathlib.Path(folder)


def _make_folder(
    name: str, folder: str | pathlib.Path | None, chosen: pathlib.Path
) -> pathlib.Path:
    if folder is None:
        return new_run_folder(name, chosen)
    return prepare_folder(chosen)


@contextlib.contextmanager
def _locked(folder: pathlib.Path) -> Iterator[None]:
    """The lock of the run folder, held by the process that writes."""
    with contextlib.ExitStack() as stack:
        on_writer(lambda: stack.enter_context(locked(folder)))
        yield


def _newest_step(
    trainer: Trainer, folder: pathlib.Path, checkpoints: RunCheckpoints, shapes: LoopState
) -> str:
    """The vector step of the newest checkpoint; empty where the run did not come so far."""
    return str(checkpoints.find_newest(shapes)) if _has_saved(trainer, folder) else ""


def _continue_files(folder: pathlib.Path, run: SavedRun, saved: SavedRun, done: int) -> None:
    """Brings the files of a run to the step that it continues from."""
    if run.config != saved.config:
        save_run(folder, run)
    for seed_folder in seed_folders(folder, run.config):
        keep_metrics(seed_folder, done)


def _check_same_run(trainer: Trainer, recorded: Record, options: dict[str, Any]) -> None:
    """Rejects processes of one run that were given different options."""
    config, installed = trainer.config, versions()
    # Without those that only one process can have, whose tokens differ.
    parts = {name: entry for name, entry in recorded.items() if "only_in" not in entry}
    all_options = {name: get_option(config, name) for name in flat_names(config)} | options
    check_same(
        {
            "version": f"mjx_arm {installed['mjx-arm']}, jax {installed['jax']}",
            "number of devices": str(_local_devices(trainer)),
            "scene": trainer.env.scene.source.digest,
            "object": json.dumps(parts, sort_keys=True),
        }
        | {name: str(value) for name, value in all_options.items()}
    )


def _with_backend(config: TrainConfig, trainer: Trainer) -> TrainConfig:
    """With the backend by name: on another device, `auto` may mean another, with other states."""
    return set_train_options(config, {"physics": trainer.env.physics.backend})


def _scene_of(folder: pathlib.Path, saved: SavedRun, objects: Objects) -> Scene:
    """The scene of a run that is resumed.

    Raises:
      ValueError: it has changed since the run was started.
    """
    name = saved.config.env.scene_name
    source = saved.scene
    if objects.env is not None:
        source = objects.env.scene.source
    elif scene_exists(name):
        source = read_source(name)
    if source.digest != saved.scene.digest:
        raise ValueError(
            f"the scene {name!r} has changed since the run in {folder} was started: restore it"
        )
    return compile_scene(name, source)


def _check_same_env(saved: TrainConfig, given: TrainConfig, folder: pathlib.Path) -> None:
    """Rejects an environment that is passed again with other options."""
    for name in flat_names(saved.env):
        was, now = get_option(saved.env, name), get_option(given.env, name)
        if was != now:
            raise ValueError(f"{folder} was made with an env= of {name} = {was}, got {now}")


def _read_policy(trainer: Trainer, path: pathlib.Path) -> Any:
    """The parameters of an agent, for each seed, to start a run from."""
    path = find_agent(path)
    tensors = read_agent(path)[1]
    flat = flatten_params(trainer.algorithm.policy(trainer.shapes().learner))
    seeds = () if trainer.config.num_seeds == 1 else (trainer.config.num_seeds,)
    shapes = {name: x.shape[len(seeds) :] for name, x in flat.items()}
    if {name: x.shape for name, x in tensors.items()} != shapes:
        raise ValueError(
            f"--init-from {path} holds the parameters of another network than this run trains"
        )
    check_tensors(path, tensors, {name: x.dtype for name, x in flat.items()})
    arrays = {name: jnp.broadcast_to(tensors[name], (*seeds, *shapes[name])) for name in flat}
    return flax.traverse_util.unflatten_dict(arrays, sep="/")


def _check_options(eval_episodes: int, stop_at: float | None, minutes: float | None) -> None:
    check_value("eval_episodes", Count, eval_episodes)
    check_value("stop_at", Discount | None, stop_at)
    check_value("minutes", Positive | None, minutes)


def _check_selects(config: TrainConfig, stop_at: float | None) -> None:
    if stop_at is not None and config.select_every == 0:
        raise ValueError(
            f"stop_at is a success rate of the selections, of which there are none: got {stop_at} "
            "with select_every 0"
        )


def _check_whole_run(folder: pathlib.Path) -> None:
    """Rejects the folder of one seed of several, whose checkpoints are those of all."""
    parent = folder.resolve().parent
    if not (parent / "config.json").is_file():
        return
    try:
        seeds = seed_folders(parent, load_run(parent).config)
    except ValueError:
        return  # some other program's file
    if len(seeds) > 1 and folder.resolve() in seeds:
        raise ValueError(f"{folder} is one seed of several: give the folder of all, {parent}")


def _has_saved(trainer: Trainer, folder: pathlib.Path) -> bool:
    """Whether a run got as far as its first checkpoint; that may be its last."""
    config = trainer.config
    unsaved = _SAVE_EVERY * config.chunk_length * config.num_envs
    first = seed_folders(folder, config)[0]
    ended = (first / EVALUATION).is_file()
    return ended or RunCheckpoints(folder).newest() is not None or last_env_steps(first) > unsaved


def _prepare(
    config: TrainConfig,
    objects: Objects,
    console: Console,
    devices: int | None,
    scene: Scene | None = None,
) -> Trainer:
    check_device()
    say_device(console)
    for sentence in advice(config):
        console.print(f"[yellow]warning: {sentence}[/yellow]", soft_wrap=True)
    parts = objects.given()
    if scene is not None and objects.env is None:
        parts["env"] = make_env(config.env, reward=parts.pop("reward", None), scene=scene)
    mesh = make_mesh(_num_devices(config, objects, devices, console))
    trainer = make_trainer(config, **parts, mesh=mesh)
    if mesh is not None:
        say_mesh(console, mesh.size, by_seed=shards_seeds(config, mesh.size))
    plan = memory_plan(trainer.shapes())
    say_memory(console, plan)
    check_memory(plan, _local_devices(trainer) * processes_here())
    return trainer


def _num_devices(
    config: TrainConfig, objects: Objects, devices: int | None, console: Console
) -> int:
    """The number of local devices of a run: as asked for, or as many as divide its work."""
    check_value("devices", Count | None, devices)
    if devices is not None:
        return devices
    most = most_devices(config)
    if most < jax.local_device_count():
        try:
            check_division(config, jax.local_device_count() * jax.process_count())
        except ValueError as reason:
            used = f"{most} of {jax.local_device_count()} devices are used"
            console.print(f"{used}: {reason}", soft_wrap=True)
    total = most * jax.process_count()
    if objects.algorithm is not None and not shards_seeds(config, total):
        # An algorithm that knows nothing of other devices trains on one, as it always did.
        with contextlib.suppress(ValueError):
            check_takes_shard(objects.algorithm, total)
            return most
        return 1
    return most


def _local_devices(trainer: Trainer) -> int:
    return 1 if trainer.mesh is None else len(trainer.mesh.local_devices)


def _compile(trainer: Trainer, console: Console) -> RunChunk:
    """The compiled chunk; rejected where what it needs to work in does not fit beside the state."""
    shapes = trainer.shapes()
    with phase(console, "compiling", "about a minute"):
        compiled = trainer.run_chunk.lower(shapes).compile()
    devices = 1 if trainer.mesh is None else trainer.mesh.size
    simulations = trainer.config.num_seeds * trainer.config.num_envs // devices
    working = working_memory(compiled, trainer.env.physics, simulations)
    plan = memory_plan(shapes) | {"working": working}
    say_working_memory(console, plan)
    check_memory(plan, _local_devices(trainer) * processes_here())
    # The first chunk waits for the other processes too, but not as patiently.
    wait_for_all()
    return compiled


class _Results:
    """What the chunks of one seed leave on disk: metrics, the last agent, and the best one."""

    def __init__(
        self,
        folder: pathlib.Path,
        run: SavedRun,
        trainer: Trainer,
        evaluate_params: Evaluate,
        started: float,
    ):
        self.folder, self.run, self.config = folder, run, run.config
        self._algorithm = trainer.algorithm
        self._evaluate = evaluate_params
        read = on_writer(lambda: json.dumps(read_selection_rate(folder / BEST)))
        self.best: float | None = json.loads(read)
        self._wall_before = last_wall_s(folder)
        self._started = started
        self.writer: contextlib.AbstractContextManager[Any] = contextlib.nullcontext()
        if is_writer():
            self.writer = MetricsWriter(folder)

    def add(
        self, counts: Counts, params: Any, chunk: int, *, seconds: float, select: bool
    ) -> dict[str, float]:
        """Writes the metrics of a chunk, the selection's included, and returns them."""
        length = self.config.chunk_length
        metrics = summarise(self.config, self._algorithm, counts, chunk * length)
        metrics["steps_per_s"] = length * self.config.num_envs / seconds
        metrics["selection_rate"] = math.nan
        if select:
            metrics["selection_rate"] = self._select(params, int(metrics["env_steps"]))
        metrics["wall_s"] = self._wall_before + time.perf_counter() - self._started
        if isinstance(self.writer, MetricsWriter):
            self.writer.write(metrics)
        return metrics

    def _select(self, params: Any, env_steps: int) -> float:
        rate = self._evaluate(params).rate
        # The later of two equal ones: it has seen more.
        if self.best is None or rate >= self.best:
            self.best = rate
            self._save(BEST, params, env_steps, rate)
        return rate

    def save_last(self, params: Any, env_steps: int) -> None:
        self._save(LAST, params, env_steps, None)

    def _save(self, name: str, params: Any, env_steps: int, rate: float | None) -> None:
        if not is_writer():
            return
        save_agent(
            self.folder / name,
            self.config,
            params,
            scene=self.run.scene,
            objects=self.run.objects,
            env_steps=env_steps,
            selection_rate=rate,
        )


@dataclasses.dataclass
class _Loop:
    """The chunks of a run, one after another."""

    trainer: Trainer
    saved: SavedRun
    run_chunk: RunChunk
    folder: pathlib.Path
    console: Console
    stop_at: float | None
    minutes: float | None
    on_chunk: OnChunk | None

    def run(self, state: LoopState, done: int) -> None:
        """Runs all chunks after the first `done`."""
        config, started = self.trainer.config, time.perf_counter()
        checkpoints = RunCheckpoints(self.folder, self.saved.origin)
        per_chunk = config.chunk_length * config.num_envs
        with contextlib.ExitStack() as stack:
            stack.enter_context(_offering(checkpoints))
            interruption = stack.enter_context(_Interruption(self.folder))
            total = config.num_chunks * per_chunk
            slower_from = getattr(config.algo, "student_starts", 0)
            progress = stack.enter_context(
                RunProgress(self.console, total, done * per_chunk, slower_from=slower_from)
            )
            results = self._results(started)
            for result in results:
                stack.enter_context(result.writer)
            for chunk in range(done + 1, config.num_chunks + 1):
                state, rows, params = self._advance(state, results, chunk, progress)
                progress.update(chunk * per_chunk, rows)
                if self.on_chunk is not None:
                    self.on_chunk(rows, state)
                reached = self._has_reached(results)
                late = self._is_late(rows)
                last = chunk == config.num_chunks or reached or late
                asked = any_says(interruption.asked)
                if last or chunk % _SAVE_EVERY == 0 or asked:
                    # The checkpoint last: what is older than it would not be made again.
                    for result, own in zip(results, params, strict=True):
                        result.save_last(own, chunk * per_chunk)
                    checkpoints.save(chunk * config.chunk_length, state)
                if asked and not last:
                    raise RunInterruptedError(f"saved; {_how_to_continue(self.folder)}")
                if reached:
                    self.console.print(f"stopped: every seed has reached {self.stop_at}")
                    return
                if late:
                    self.console.print(f"stopped: trained for {self.minutes:g} minutes")
                    return

    def _results(self, started: float) -> list[_Results]:
        config = self.trainer.config
        judged = self.trainer.env
        if "env" not in self.saved.objects:
            judged = make_env(
                evaluation_config(config.env), reward=judged.reward, scene=judged.scene
            )
        evaluator = make_evaluator(
            judged,
            self.trainer.algorithm.apply,
            episodes=config.select_episodes,
            epsilon=_EVALUATION_EPSILON,
            mesh=self.trainer.mesh,
        )

        def evaluate_params(params: Any) -> Evaluation:
            return evaluator(params, role_key(_SELECTION_SEED, SELECTION))

        folders = seed_folders(self.folder, config)
        return [
            _Results(
                own,
                dataclasses.replace(self.saved, config=seed_config),
                self.trainer,
                evaluate_params,
                started,
            )
            for own, seed_config in zip(folders, seed_configs(config), strict=True)
        ]

    def _advance(
        self, state: LoopState, results: list[_Results], chunk: int, progress: RunProgress
    ) -> tuple[LoopState, list[dict[str, float]], list[Any]]:
        """One chunk: the state after, and the metrics and the policy of each seed."""
        config = self.trainer.config
        before = time.perf_counter()
        state, counts = self.run_chunk(state)
        counts = fetch(counts)
        seconds = time.perf_counter() - before
        last = chunk == config.num_chunks
        # A policy that does not act yet has not learnt yet, and its episodes are the longest.
        env_steps = jnp.asarray(chunk * config.chunk_length * config.num_envs)
        acts = bool(self.trainer.algorithm.acts_on_obs(env_steps))
        select = config.select_every > 0 and (last or (acts and _is_due(config, chunk)))
        if select:
            progress.phase(f"selecting: {config.select_episodes} episodes")
        policy = self.trainer.algorithm.policy(state.learner)
        if self.trainer.mesh is not None:
            policy = fetch(policy)
        params = [of_seed(policy, config, i) for i in range(len(results))]
        rows = [
            result.add(of_seed(counts, config, i), params[i], chunk, seconds=seconds, select=select)
            for i, result in enumerate(results)
        ]
        return state, rows, params

    def _is_late(self, rows: list[dict[str, float]]) -> bool:
        if self.minutes is None:
            return False
        return any_says(rows[0]["wall_s"] >= 60 * self.minutes)

    def _has_reached(self, results: list[_Results]) -> bool:
        if self.stop_at is None:
            return False
        return all(result.best is not None and result.best >= self.stop_at for result in results)


@contextlib.contextmanager
def _offering(checkpoints: RunCheckpoints) -> Iterator[None]:
    """Adds to an error about a file which checkpoint is whole, in the same sentence."""
    try:
        yield
    except (OSError, ValueError) as error:
        said = str(error)
        if isinstance(error, OSError):
            said = f"{error.filename or checkpoints.folder}: {error.strerror or error}"
        newest = checkpoints.newest()
        offer = f"; --resume continues from {newest}, which is whole" if newest else ""
        raise ValueError(f"{said}{offer}") from error


def _is_due(config: TrainConfig, chunk: int) -> bool:
    """Whether a selection falls into this chunk."""
    per_chunk = config.chunk_length * config.num_envs
    return chunk * per_chunk // config.select_every > (chunk - 1) * per_chunk // config.select_every


def _how_to_continue(folder: pathlib.Path) -> str:
    resume = ["-m", "mjx_arm", "train", "--resume", str(folder)]
    return f"continue with: {shlex.join([sys.executable, *resume])}"


class _Interruption:
    """Turns the first signal into a wish to stop after the chunk; a second Ctrl-C acts as before.

    Args:
      folder: of the run, for what it says.
    """

    def __init__(self, folder: pathlib.Path) -> None:
        self.asked = False
        self._folder = folder
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        # Only the main thread may set handlers.
        if threading.current_thread() is threading.main_thread():
            self._before = {
                number: signal.signal(number, self._handle) for number in stop_signals()
            }
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        before = self._before[number]
        # Schedulers may send theirs more than once: only a second Ctrl-C means at once.
        if self.asked and number == signal.SIGINT and callable(before):
            _say(f"steps since the newest checkpoint are lost; {_how_to_continue(self._folder)}")
            before(number, frame)
        if not self.asked and number == signal.SIGINT:
            _say("saving after this chunk; a second Ctrl-C ends the run at once, without saving")
        self.asked = True


def _say(sentence: str) -> None:
    """Prints from a signal handler, which may have interrupted another print."""
    with contextlib.suppress(OSError):  # the terminal may be gone
        os.write(2, f"{sentence}\n".encode(errors="replace"))


@dataclasses.dataclass(frozen=True)
class _Ending:
    """What becomes of a run at its end.

    Attributes:
      eval_episodes: episodes of the evaluation.
      console: where it prints.
      devices: local devices that share the evaluation.
      video: record an episode.
    """

    eval_episodes: int
    console: Console
    devices: int
    video: bool = True


def _finish_on_writer(
    folder: pathlib.Path, run: SavedRun, objects: Objects, ending: _Ending
) -> list[Evaluation]:
    """What `_finish` returns, in every process."""
    results: list[Evaluation] = []

    def finish() -> str:
        mesh = make_mesh(ending.devices, of_all=False)
        results.extend(_finish(folder, run, objects, ending, mesh))
        return json.dumps([dataclasses.asdict(result) for result in results])

    said = on_writer(finish)
    if results:
        return results
    return [Evaluation(**{**x, "ci95": tuple(x["ci95"])}) for x in json.loads(said)]


def _finish(
    folder: pathlib.Path,
    run: SavedRun,
    objects: Objects,
    ending: _Ending,
    mesh: jax.sharding.Mesh | None,
) -> list[Evaluation]:
    folders, console = seed_folders(folder, run.config), ending.console
    if len(folders) > 1:
        _draw_curves(folders, folder, run.config, console)
    results = []
    for own in folders:
        _draw_curves([own], own, run.config, console)
        results.append(_evaluate_seed(own, objects, ending, mesh))
    with phase(console, "writing the report"):
        if len(folders) > 1:
            for own, config in zip(folders, seed_configs(run.config), strict=True):
                write_report(own, config, [own])
        report = write_report(folder, run.config, folders)
    console.print(f"report: {report}", soft_wrap=True)
    return results


def _draw_curves(
    folders: list[pathlib.Path], into: pathlib.Path, config: TrainConfig, console: Console
) -> None:
    with phase(console, "drawing the curves"):
        paths = plot_curves(folders, into=into, units=find_task(config.env.task).units)
    for path in paths:
        console.print(f"curves: {path}", soft_wrap=True)


def _evaluate_seed(
    folder: pathlib.Path,
    objects: Objects,
    ending: _Ending,
    mesh: jax.sharding.Mesh | None,
) -> Evaluation:
    console = ending.console
    key = role_key(_EVALUATION_SEED, EVALUATION_ROLE)
    with phase(console, "evaluating", f"{ending.eval_episodes} episodes"):
        scene = None if objects.env is not None else STORED
        agent = load_agent(folder, scene=scene, **objects.given())
        said = f"agent: {find_agent(folder)}, after {agent.env_steps:,} steps"
        console.print(said, soft_wrap=True)
        result = evaluate(
            agent.env,
            agent.apply,
            agent.params,
            episodes=ending.eval_episodes,
            epsilon=_EVALUATION_EPSILON,
            key=key,
            mesh=mesh,
        )
    (folder / EVALUATION).write_text(json.dumps(dataclasses.asdict(result)) + "\n")
    add_evaluation(find_agent(folder), dataclasses.asdict(result))
    low, high = result.ci95
    console.print(
        f"evaluation: {result.successes} of {result.episodes} episodes succeeded, "
        f"{100 * result.rate:.1f} % (95 % interval {100 * low:.1f} to {100 * high:.1f})"
    )
    if not ending.video:
        return result
    path = folder / "policy.mp4"
    with phase(console, "rendering a video"):
        episode = record_episode(
            agent.env, agent.apply, agent.params, epsilon=_EVALUATION_EPSILON, key=key
        )
        write_video(path, render_episode(agent.env, episode))
    console.print(
        f"video: {path} ({len(episode)} frames, success: {episode.success})", soft_wrap=True
    )
    return result
