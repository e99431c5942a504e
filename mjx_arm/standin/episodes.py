"""Episodes in the stand-in, in one process for each core."""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import multiprocessing
import os
import pickle
import signal
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Protocol

import numpy as np

from mjx_arm.cores import usable_cores
from mjx_arm.envs.env import Env
from mjx_arm.options import Count, CountOrZero, check_value
from mjx_arm.policy import Policy
from mjx_arm.standin.levels import Offsets
from mjx_arm.standin.opengl import opengl_for_children
from mjx_arm.standin.world import Measured, StandIn

# XLA's own threads would compete with the other processes.
_ONE_THREAD = "--xla_cpu_multi_thread_eigen=false"


@dataclasses.dataclass(frozen=True)
class Start:
    """Where an episode starts, at rest.

    Attributes:
      qpos: `[nq] float32`, rad and m.
      ctrl: `[nu] float32`, rad and m.
    """

    qpos: np.ndarray
    ctrl: np.ndarray


@dataclasses.dataclass(frozen=True)
class Trace:
    """One episode of `L` iterations; the states are those before each action, and the last one.

    Attributes:
      distance: `[L + 1] float64`, between the grasp site and the cube's centre, m.
      height: `[L + 1] float64`, of the cube above its rest, m.
      grasped: `[L + 1] bool`.
      action: `[L] int64`.
      success: the episode ended in success.
    """

    distance: np.ndarray
    height: np.ndarray
    grasped: np.ndarray
    action: np.ndarray
    success: bool


@dataclasses.dataclass(frozen=True)
class Moment:
    """One state of an episode, for a film.

    Attributes:
      qpos: `[nq] float64`.
      image: `[H, W, 3] uint8`, what the agent sees.
      max_q: the largest Q-value.
    """

    qpos: np.ndarray
    image: np.ndarray
    max_q: float


class Film(Protocol):
    """Makes something of an episode, such as a video; it must be picklable."""

    def __call__(self, world: StandIn, moments: Sequence[Moment], trace: Trace) -> None:
        """Is called once, after the episode, in the process that ran it."""
        ...


@dataclasses.dataclass(frozen=True)
class Job:
    """What all episodes have in common.

    Attributes:
      env: the simulator's environment.
      offsets: of the level.
      policy: as `mjx_arm.export.export_policy` returns it.
      iterations: an episode without success ends after this number.
      epsilon: share of random actions.
      seed: of the random actions.
      shadows: render shadows.
    """

    env: Env
    offsets: Offsets
    policy: bytes
    iterations: int
    epsilon: float
    seed: int
    shadows: bool = True


class Runner:
    """Runs episodes of a job in this process, one after the other.

    Raises:
      ValueError: there is no OpenGL, or the policy or the environment does not fit.
    """

    def __init__(self, job: Job) -> None:
        self.job, self.policy = job, Policy(job.policy)
        self.world = StandIn(job.env, job.offsets, shadows=job.shadows)

    def run(self, number: int, start: Start, film: Film | None = None) -> Trace:
        """Runs one episode.

        Args:
          number: of the episode; its random actions depend on it and on the job's seed.
          start: where it starts.
          film: is given the episode.
        """
        rng = np.random.default_rng([self.job.seed, number])
        world = self.world
        moments: list[Moment] = []
        actions: list[int] = []
        world.reset(start.qpos, start.ctrl)
        states = [world.measure()]
        while len(actions) < self.job.iterations and not (states[-1].success or world.diverged):
            q, action = self.policy(world.image)
            if film is not None:
                moments.append(Moment(world.data.qpos.copy(), world.image, float(q.max())))
            if rng.random() < self.job.epsilon:
                action = int(rng.integers(self.policy.num_actions))
            world.step(action)
            actions.append(action)
            states.append(world.measure())
        trace = _trace(states, actions)
        if film is not None:
            last = float(self.policy(world.image)[0].max())
            moments.append(Moment(world.data.qpos.copy(), world.image, last))
            film(world, moments, trace)
        return trace


def _trace(states: Sequence[Measured], actions: Sequence[int]) -> Trace:
    return Trace(
        distance=np.asarray([state.distance for state in states]),
        height=np.asarray([state.height for state in states]),
        grasped=np.asarray([state.grasped for state in states]),
        action=np.asarray(actions, np.int64),
        success=states[-1].success,
    )


def run_episodes(
    job: Job,
    starts: Sequence[Start],
    *,
    processes: int | None = None,
    film: Film | None = None,
    on_episode: Callable[[Trace], None] | None = None,
) -> list[Trace]:
    """Runs an episode from each start.

    The result depends on the job and the starts, and not on the number of processes.

    Args:
      job: what all episodes have in common.
      starts: of the episodes, at least one.
      processes: number of processes; by default one for each core. They are spawned, so a script
        needs `if __name__ == "__main__":`. With 0 all episodes run in this process, which then must
        have found MuJoCo's OpenGL when it imported mujoco.
      film: is given the first episode, in the process that runs it.
      on_episode: is called with each episode as it ends, in any order.

    Returns:
      The episodes in the order of their starts.

    Raises:
      ValueError: an invalid argument, or there is no OpenGL, the policy does not fit, or a process
        has ended.
    """
    check_value("the number of starts", Count, len(starts))
    check_value("processes", CountOrZero | None, processes)
    told = on_episode or (lambda trace: None)
    if processes == 0:
        runner, traces = Runner(job), []
        with contextlib.closing(runner.world):
            for i, start in enumerate(starts):
                traces.append(runner.run(i, start, film if i == 0 else None))
                told(traces[-1])
        return traces
    count = min(len(starts), processes or usable_cores())
    pool = concurrent.futures.ProcessPoolExecutor(
        max_workers=count,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_start_process,
        initargs=(pickle.dumps(job), os.getpid()),
    )
    with opengl_for_children(), pool:
        futures = [
            pool.submit(_run, i, start, film if i == 0 else None) for i, start in enumerate(starts)
        ]
        try:
            for future in concurrent.futures.as_completed(futures):
                told(future.result())
        except BrokenProcessPool as error:
            raise ValueError(
                "a process of the stand-in has ended before its episodes: it may have run out of "
                "memory"
            ) from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return [future.result() for future in futures]


_runner: Runner | ValueError | None = None


def _start_process(job: bytes, parent: int) -> None:
    """Prepares a process: what depends on the environment variables comes after them."""
    global _runner
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {_ONE_THREAD}".strip()
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=end_with, args=(parent,), daemon=True).start()
    try:
        _runner = Runner(pickle.loads(job))
    except ValueError as error:
        _runner = error


def _run(number: int, start: Start, film: Any) -> Trace:
    if isinstance(_runner, ValueError):
        raise _runner
    assert _runner is not None
    return _runner.run(number, start, film)


def end_with(parent: int) -> None:
    """Ends this process as soon as the process `parent` has ended; never returns."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)
