"""The control loop: at a fixed rate an image, an action, a step of the robot.

The robot is told to stop whenever the loop ends, however that is.
"""

from __future__ import annotations

import contextlib
import dataclasses
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any, Literal, Protocol

import numpy as np

from mjx_arm.deploy.clock import Clock, WallClock
from mjx_arm.deploy.guard import Guard
from mjx_arm.deploy.log import Log
from mjx_arm.deploy.robot import Frame, Robot, RobotError
from mjx_arm.options import Positive, Share, options
from mjx_arm.policy import check_image

Ending = Literal["done", "stopped", "fault"]


class ImagePolicy(Protocol):
    """A policy of images, as `mjx_arm.policy.Policy`."""

    @property
    def image_shape(self) -> tuple[int, ...]:
        """Shape of the images."""
        ...

    @property
    def num_actions(self) -> int:
        """Number of actions."""
        ...

    def __call__(self, image: np.ndarray) -> tuple[np.ndarray, int]:
        """Q-values `[A] float32` and the best action."""
        ...


@options
class LoopConfig:
    """Options of the control loop.

    Attributes:
      rate: actions per second. Training has 50 per second of physics: at 25 the arm moves half as
        fast as in training.
      seconds: the loop ends after this time, s.
      epsilon: share of random actions.
      degrees: step of a joint, degrees.
      watchdog: the robot is stopped if the newest image is older than this, s.
      dry_run: the loop sends nothing to the robot, not even the stop.
      seed: of the random actions.
    """

    rate: Positive = 25.0
    seconds: Positive = 60.0
    epsilon: Share = 0.1
    degrees: Positive = 1.0
    watchdog: Positive = 0.3
    dry_run: bool = False
    seed: int = 0


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How a run of the loop ended.

    Attributes:
      ending: `done` (time is up, or `until` was true), `stopped` (by the user) or `fault`.
      reason: one sentence.
      ticks: number of complete ticks; one in which the robot fails is not complete.
      misses: ticks that were not over before the next one was due.
      skipped: ticks that were due while a late one lasted, and were left out. Their deadlines were
        missed as well: of `ticks + skipped` deadlines `misses + skipped` were missed.
      rejected: actions that the guard did not let through.
      inference_ms: `[ticks] float64`, time of the policy, ms.
      image_age_ms: `[ticks] float64`, age of the image when the action was sent, ms.
    """

    ending: Ending
    reason: str
    ticks: int
    misses: int
    skipped: int
    rejected: int
    inference_ms: np.ndarray
    image_age_ms: np.ndarray


@dataclasses.dataclass
class _Tally:
    misses: int = 0
    skipped: int = 0
    rejected: int = 0
    inference_ms: list[float] = dataclasses.field(default_factory=list)
    image_age_ms: list[float] = dataclasses.field(default_factory=list)


def run_loop(
    robot: Robot,
    policy: ImagePolicy,
    guard: Guard,
    config: LoopConfig,
    log: Log,
    *,
    clock: Clock | None = None,
    stop: threading.Event | None = None,
    until: Callable[[], bool] | None = None,
) -> Outcome:
    """Drives a robot by a policy until the time is up, something fails, or the user stops it.

    A tick: newest image, joint angles, Q-values, action, guard, command. What the robot reports is
    checked before it is used. A late tick counts as a miss, and the ticks that were due meanwhile
    are skipped. However the loop ends, the robot is told to stop and the log gets a last line.

    Args:
      robot: to drive.
      policy: epsilon-greedy by its Q-values.
      guard: of the arm.
      config: rate, time and so on.
      log: gets every tick, and the end.
      clock: by default the real one.
      stop: ends the loop within a tick when it is set; see `stop_on_signals`.
      until: is called before each tick; the loop ends when it returns true.

    Returns:
      How the loop ended. A failure of the robot is an outcome with the ending `fault`.

    Raises:
      ValueError: policy and guard are of different numbers of joints.
    """
    joints = len(guard.limits)
    if policy.num_actions != 2 * joints + 2:
        raise ValueError(f"a policy of {policy.num_actions} actions cannot drive {joints} joints")
    policy(np.zeros(policy.image_shape, np.uint8))  # compiles before the first deadline
    clock = WallClock() if clock is None else clock
    stop = threading.Event() if stop is None else stop
    loop = _Loop(robot, policy, guard, config, log, clock, stop, until)
    return loop.run()


@dataclasses.dataclass(eq=False)
class _Loop:
    robot: Robot
    policy: ImagePolicy
    guard: Guard
    config: LoopConfig
    log: Log
    clock: Clock
    stop: threading.Event
    until: Callable[[], bool] | None

    def run(self) -> Outcome:
        self.tally, self.rng = _Tally(), np.random.default_rng(self.config.seed)
        ending: Ending = "fault"
        reason = "the loop has failed"
        try:
            ending, reason = self._ticks()
        except RobotError as error:
            reason = str(error)
        except BaseException as error:
            reason = f"the loop has failed: {type(error).__name__}"
            raise
        finally:
            try:
                reason = self._stop_robot(reason)
            finally:
                with contextlib.suppress(OSError):  # a full disk has ended the loop already
                    self.log.write(self._last_line(ending, reason))
        tally = self.tally
        ages, times = np.asarray(tally.image_age_ms), np.asarray(tally.inference_ms)
        counts = len(times), tally.misses, tally.skipped, tally.rejected
        return Outcome(ending, reason, *counts, times, ages)

    def _ticks(self) -> tuple[Ending, str]:
        period, tick = 1 / self.config.rate, 0
        self.robot.frame()  # the first image may take a while
        start = self.clock.now()
        while not self.stop.is_set():
            if self.until is not None and self.until():
                return "done", "the task is done"
            if tick * period >= self.config.seconds:
                return "done", f"the time of {self.config.seconds:g} s is up"
            late = self._tick(tick, start + (tick + 1) * period)
            passed = self.clock.now() - start
            due = max(tick + 1, int(passed / period) + 1) if late else tick + 1
            self.tally.skipped += due - tick - 1
            tick = due
            self.clock.wait_until(start + tick * period, self.stop)
        return "stopped", "stopped by the user"

    def _tick(self, tick: int, deadline: float) -> bool:
        """Returns whether the tick was late."""
        clock, tally, began = self.clock, self.tally, self.clock.now()
        frame = self.robot.frame()
        self._check_frame(frame)
        angles = self.guard.check(self.robot.joint_angles())
        thinks = clock.now()
        q, best = self.policy(frame.image)
        inference_ms = 1000 * (clock.now() - thinks)
        action, rejected = self._choose(best), None
        if action < 2 * len(angles):
            rejected = self.guard.rejects(angles, action // 2, self._step(action))
        # Again, for joints and policy may have taken long.
        self._check_age(frame)
        sends = rejected is None and not self.config.dry_run and not self.stop.is_set()
        try:
            if sends:
                self._send(action)
        finally:
            # Also where the robot fails in the middle: the log then has the command that it got.
            sent = clock.now()
            tally.rejected += rejected is not None
            tally.inference_ms.append(inference_ms)
            tally.image_age_ms.append(1000 * (sent - frame.time))
            late = sent > deadline
            tally.misses += late
            self.log.write(
                {
                    "tick": tick,
                    "time": began,
                    "image_number": frame.number,
                    "image_age_ms": tally.image_age_ms[-1],
                    "inference_ms": inference_ms,
                    "angles": angles,
                    "q": q,
                    "best": best,
                    "action": action,
                    "sent": sends,
                    "rejected": rejected,
                    "late": late,
                    "image": frame.image,
                }
            )
        return late

    def _check_frame(self, frame: Frame) -> None:
        try:
            check_image(frame.image, self.policy.image_shape)
        except ValueError as error:
            raise RobotError(f"the camera gives something else: {error}") from error
        self._check_age(frame)

    def _check_age(self, frame: Frame) -> None:
        age = self.clock.now() - frame.time
        # A camera whose clock is wrong would keep the watchdog quiet for ever.
        if not -self.config.watchdog <= age <= self.config.watchdog:
            raise RobotError(
                f"the camera is silent: its newest image is {age:.2f} s old, and "
                f"{self.config.watchdog:g} s are allowed"
            )

    def _choose(self, best: int) -> int:
        if self.rng.random() < self.config.epsilon:
            return int(self.rng.integers(self.policy.num_actions))
        return best

    def _step(self, action: int) -> float:
        return self.config.degrees if action % 2 else -self.config.degrees

    def _send(self, action: int) -> None:
        joints = len(self.guard.limits)
        if action == 2 * joints:
            self.robot.open()
        elif action == 2 * joints + 1:
            self.robot.close()
        else:
            self.robot.move_joint(action // 2, self._step(action))

    def _stop_robot(self, reason: str) -> str:
        if self.config.dry_run:
            return reason
        try:
            try:
                self.robot.stop()
            except KeyboardInterrupt:
                # A second Ctrl-C may come between two joints.
                self.robot.stop()
                raise
        except RobotError as error:
            if str(error) != reason:
                return f"{reason}; the robot could not be told to stop: {error}"
        return reason

    def _last_line(self, ending: Ending, reason: str) -> dict[str, Any]:
        tally = self.tally
        return {
            "end": reason,
            "ending": ending,
            "ticks": len(tally.inference_ms),
            "misses": tally.misses,
            "skipped": tally.skipped,
            "rejected": tally.rejected,
        }


def describe_outcome(outcome: Outcome) -> dict[str, Any]:
    """An outcome as a JSON object, with medians and the 99th percentile instead of all times."""
    report: dict[str, Any] = {
        "ending": outcome.ending,
        "reason": outcome.reason,
        "ticks": outcome.ticks,
        "misses": outcome.misses,
        "skipped": outcome.skipped,
        "rejected": outcome.rejected,
    }
    for name in ("inference_ms", "image_age_ms"):
        times = getattr(outcome, name)
        for what, percent in (("median", 50), ("p99", 99)):
            value = float(np.percentile(times, percent)) if len(times) else None
            report[f"{name}_{what}"] = value
    return report


@contextlib.contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """An event that Ctrl-C and SIGTERM set while the `with` block runs; for the main thread.

    The loop then ends within a tick, stops the robot and finishes its log. A second signal raises
    KeyboardInterrupt at once; the robot is still told to stop.
    """
    stop = threading.Event()

    def handle(number: int, frame: FrameType | None) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
