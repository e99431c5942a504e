from __future__ import annotations

import dataclasses
import json
import os
import re
import signal
import threading

import numpy as np
import pytest
from robots import SHAPE, SimulatedClock, Thinker, TwoJoints

from mjx_arm.deploy.guard import Guard, make_guard
from mjx_arm.deploy.log import Log, read_log, replay
from mjx_arm.deploy.loop import LoopConfig, Outcome, run_loop, stop_on_signals
from mjx_arm.deploy.robot import Frame
from mjx_arm.envs.arm import resolve_arm
from mjx_arm.scene import SceneSource, compile_scene

OPEN, CLOSE = 4, 5

# Two hinges in a plane, 20 cm each; with both at 0 the arm points along x at a height of 30 cm.
XML = """
<mujoco>
  <compiler angle="degree"/>
  <worldbody>
    <camera name="front"/>
    <body pos="0 0 0.3">
      <joint name="one" axis="0 1 0" range="-90 90"/>
      <geom type="capsule" size="0.01" fromto="0 0 0 0.2 0 0" contype="0" conaffinity="0"/>
      <body pos="0.2 0 0">
        <joint name="two" axis="0 1 0" range="-90 90"/>
        <geom type="capsule" size="0.01" fromto="0 0 0 0.2 0 0" contype="0" conaffinity="0"/>
        <site name="grasp" pos="0.2 0 0"/>
        <body><joint name="left_finger" type="slide" axis="0 1 0" range="0 0.05"/>
          <geom size="0.01" mass="0.1" contype="0" conaffinity="0"/></body>
        <body><joint name="right_finger" type="slide" axis="0 -1 0" range="0 0.05"/>
          <geom size="0.01" mass="0.1" contype="0" conaffinity="0"/></body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="one" joint="one" kp="10" ctrlrange="-1.570796 1.570796"/>
    <position name="two" joint="two" kp="10" ctrlrange="-1.570796 1.570796"/>
    <position name="gripper" joint="left_finger" kp="10" ctrlrange="0 0.05"/>
  </actuator>
  <keyframe><key name="home" qpos="0 0 0.05 0.05" ctrl="0 0 0.05"/></keyframe>
</mujoco>
"""


@pytest.fixture(scope="module")
def guard() -> Guard:
    scene = compile_scene("two", SceneSource(XML))
    arm = resolve_arm(scene)
    limits = np.asarray([[-90.0, 90.0], [-90.0, 20.0]])
    return Guard(limits, np.asarray([[-1, -1, 0.05], [1, 1, 1]], float), scene, arm)


@dataclasses.dataclass
class Run:
    """What a run of the loop left."""

    outcome: Outcome
    robot: TwoJoints
    clock: SimulatedClock
    path: object


@pytest.fixture
def run(guard, tmp_path):
    def run_once(
        *, actions=(0,), takes=0.002, prepare=lambda robot: None, until=None, stop=None, **options
    ) -> Run:
        clock = SimulatedClock()
        robot = TwoJoints(clock)
        prepare(robot)
        config = LoopConfig(**({"rate": 25.0, "seconds": 1.0, "epsilon": 0.0} | options))
        path = tmp_path / "log.jsonl"
        with Log(path, {"robot": "two"}) as log:
            outcome = run_loop(
                robot,
                Thinker(clock, list(actions), takes),
                guard,
                config,
                log,
                clock=clock,
                until=until,
                stop=stop,
            )
        return Run(outcome, robot, clock, path)

    return run_once


@pytest.mark.parametrize("rate", [25.0, 50.0])
def test_the_loop_keeps_its_rate(run, rate) -> None:
    made = run(rate=rate, seconds=2.0, actions=[0, 3, OPEN, CLOSE])
    assert made.outcome.ending == "done"
    assert made.outcome.reason == "the time of 2 s is up"
    assert made.outcome.ticks == 2 * rate
    assert made.outcome.misses == 0
    assert np.diff(made.clock.waits) == pytest.approx(np.full(int(2 * rate) - 1, 1 / rate))
    assert made.robot.told[:4] == [("move", 0, -1.0), ("move", 1, 1.0), ("open",), ("close",)]
    assert made.robot.told[-1] == ("stop",)
    assert made.outcome.inference_ms == pytest.approx(np.full(made.outcome.ticks, 2.0))


def test_a_late_tick_is_a_miss_and_nothing_is_caught_up(run) -> None:
    def prepare(robot: TwoJoints) -> None:
        def frame(number: int) -> Frame:
            made = robot.good_frame(number)
            robot.clock.pass_(0.09 if number == 5 else 0.0)  # more than two periods of 40 ms
            return made

        robot.make_frame = frame

    made = run(prepare=prepare)
    assert made.outcome.misses == 1
    assert made.outcome.skipped == 2
    assert made.outcome.ticks == 25 - 2
    ticks = [record["tick"] for record in read_log(made.path).ticks]
    assert ticks == [0, 1, 2, 3, *range(6, 25)]


def test_random_actions_have_their_share(run) -> None:
    made = run(epsilon=0.5, seconds=20.0, actions=[OPEN])
    others = sum(told != ("open",) for told in made.robot.told[:-1]) + made.outcome.rejected
    assert 0.3 < others / made.outcome.ticks < 0.55  # 5 of 6 random actions are others


def test_a_dry_run_sends_nothing(run) -> None:
    made = run(dry_run=True)
    assert made.outcome.ticks == 25
    assert made.robot.told == []
    assert not any(tick["sent"] for tick in read_log(made.path).ticks)


def test_the_task_may_be_done(run) -> None:
    calls = iter([False, False, True])
    made = run(until=lambda: next(calls))
    assert (made.outcome.ending, made.outcome.ticks) == ("done", 2)
    assert made.robot.told[-1] == ("stop",)


def test_the_joints_stay_in_their_range(run) -> None:
    made = run(actions=[3], seconds=2.0)
    assert made.robot.angles.tolist() == [0.0, 20.0]
    assert made.outcome.rejected == 50 - 10
    ticks = read_log(made.path).ticks
    assert [tick["sent"] for tick in ticks] == [True] * 10 + [False] * 40
    assert ticks[-1]["rejected"] == "joint 1 would leave its range"


def test_the_gripper_stays_in_its_box(run, guard) -> None:
    made = run(actions=[1], seconds=4.0)
    assert guard.gripper(made.robot.angles)[2] >= 0.05
    assert guard.gripper(made.robot.angles + np.asarray([1.0, 0.0]))[2] < 0.05
    assert read_log(made.path).ticks[-1]["rejected"] == "the gripper would leave the workspace"
    # The way back is free.
    assert guard.rejects(np.asarray([60.0, 10.0]), 0, -1.0) is None
    assert guard.rejects(np.asarray([60.0, 10.0]), 0, 1.0) is not None
    assert guard.rejects(np.asarray([0.0, 25.0]), 1, -1.0) is None


@pytest.mark.parametrize("box", [(0, 0, 0, 1, 1), (0, 0, 0, 1, 1, 0), (0, 0, 0, 1, 1, np.nan)])
def test_a_workspace_is_a_box(guard, box) -> None:
    with pytest.raises(ValueError, match="the workspace must be x y z of its lower corner"):
        make_guard(guard.scene, guard.arm, box)


def image_of(robot: TwoJoints, image: object) -> None:
    def make(number: int) -> Frame:
        return Frame(image if number > 4 else robot.good_frame(number).image, robot.clock.now(), 1)

    robot.make_frame = make


def angles_of(robot: TwoJoints, angles: object) -> None:
    good = robot.make_angles

    def make() -> object:
        return angles if robot.frames > 4 else good()

    robot.make_angles = make


def silent(robot: TwoJoints) -> None:
    last = robot.good_frame(1)
    good = robot.make_frame
    robot.make_frame = lambda number: good(number) if number < 5 else last


def slow(robot: TwoJoints) -> None:
    good = robot.make_angles

    def make() -> object:
        robot.clock.pass_(0.31 if robot.frames > 4 else 0.0)
        return good()

    robot.make_angles = make


BAD_INPUT = {
    "shape": (
        lambda robot: image_of(robot, np.zeros((6, 4, 3), np.uint8)),
        r"an image must be of shape \[4, 6, 3\] and type uint8, got \[6, 4, 3\] and uint8",
    ),
    "type": (
        lambda robot: image_of(robot, np.zeros(SHAPE, np.float32)),
        "the camera gives something else: an image must be of shape .* got .* and float32",
    ),
    "no image": (lambda robot: image_of(robot, None), "must be an array of numpy, got NoneType"),
    "nan": (
        lambda robot: angles_of(robot, np.asarray([0.0, np.nan])),
        "joint 1 reports nan degrees; its range is from -90.0 to 20.0",
    ),
    "range": (
        lambda robot: angles_of(robot, np.asarray([0.0, 400.0])),
        "joint 1 reports 400.0 degrees; its range is from -90.0 to 20.0",
    ),
    "count": (
        lambda robot: angles_of(robot, np.zeros(3)),
        r"must report 2 joint angles, got the shape \[3\]",
    ),
    # The image was new when it was taken, and is not when the command would be sent.
    "slow joints": (slow, "the camera is silent: its newest image is 0.3. s old, and 0.3 s"),
    "silent": (silent, "the camera is silent: its newest image is 0.3. s old, and 0.3 s"),
}


@pytest.mark.parametrize("kind", BAD_INPUT)
def test_bad_input_stops_the_arm_and_the_log_is_whole(run, kind) -> None:
    prepare, sentence = BAD_INPUT[kind]
    made = run(prepare=prepare, seconds=5.0)
    assert made.outcome.ending == "fault"
    assert re.search(sentence, made.outcome.reason), made.outcome.reason
    assert made.robot.told[-1] == ("stop",)
    assert sum(told[0] == "move" for told in made.robot.told) == len(made.robot.told) - 1
    log = read_log(made.path)
    assert log.end == made.outcome.reason
    assert [tick["tick"] for tick in log.ticks] == list(range(made.outcome.ticks))


def test_a_robot_that_is_gone_ends_the_loop(run) -> None:
    def prepare(robot: TwoJoints) -> None:
        robot.gone_after = 3

    made = run(prepare=prepare)
    assert made.outcome.ending == "fault"
    assert made.outcome.reason == "the robot is gone"
    assert len(made.robot.told) == 3
    # The fourth command is the one that the robot did not take: the log has it.
    assert made.outcome.ticks == len(made.outcome.inference_ms) == 4
    assert len(made.outcome.image_age_ms) == 4
    log = read_log(made.path)
    assert log.end == "the robot is gone"
    assert [tick["sent"] for tick in log.ticks] == [True] * 4


def test_what_is_not_foreseen_still_stops_the_arm(run, tmp_path) -> None:
    robots = []

    def prepare(robot: TwoJoints) -> None:
        robots.append(robot)
        image_of(robot, np.zeros(SHAPE, np.uint8))
        robot.make_angles = lambda: {}["nothing"]

    with pytest.raises(KeyError):
        run(prepare=prepare)
    assert robots[0].told == [("stop",)]
    assert read_log(tmp_path / "log.jsonl").end == "the loop has failed: KeyError"


def test_ctrl_c_stops_the_arm_within_a_tick(run) -> None:
    def prepare(robot: TwoJoints) -> None:
        def frame(number: int) -> Frame:
            if number == 6:
                os.kill(os.getpid(), signal.SIGINT)
            return robot.good_frame(number)

        robot.make_frame = frame

    handler = signal.getsignal(signal.SIGINT)
    with stop_on_signals() as stop:
        made = run(prepare=prepare, stop=stop)
    assert made.outcome.ending == "stopped"
    assert made.outcome.reason == "stopped by the user"
    # Four ticks have moved the arm; the fifth began when the signal came, and sent nothing.
    assert made.robot.told == [*[("move", 0, -1.0)] * 4, ("stop",)]
    assert signal.getsignal(signal.SIGINT) is handler
    assert read_log(made.path).end == "stopped by the user"


def test_a_second_ctrl_c_does_not_keep_the_arm_from_being_stopped(run, tmp_path) -> None:
    robots = []

    def prepare(robot: TwoJoints) -> None:
        robots.append(robot)
        stop, calls = robot.stop, iter([KeyboardInterrupt])

        def impatient() -> None:
            for error in calls:
                raise error
            stop()

        robot.stop = impatient

    with pytest.raises(KeyboardInterrupt):
        run(prepare=prepare)
    assert robots[0].told[-1] == ("stop",)
    assert read_log(tmp_path / "log.jsonl").end == "the time of 1 s is up"


def test_a_policy_of_another_arm_is_rejected(guard) -> None:
    clock = SimulatedClock()
    policy = Thinker(clock, [0])
    policy.num_actions = 14
    with pytest.raises(ValueError, match="a policy of 14 actions cannot drive 2 joints"):
        run_loop(TwoJoints(clock), policy, guard, LoopConfig(), Log(None, {}), clock=clock)


def test_a_log_can_be_replayed(run) -> None:
    made = run(actions=[0, 3, OPEN])
    log = read_log(made.path)
    assert log.header["robot"] == "two"
    assert log.ticks[3]["image"].shape == SHAPE
    assert (log.ticks[3]["image"] == log.ticks[3]["image_number"] % 256).all()
    clock = SimulatedClock()
    again = Thinker(clock, [0, 3, OPEN])
    again.asked = 0  # it was warm
    found = replay(made.path, again)
    assert (found.ticks, found.same, found.largest) == (25, 25, 0.0)
    other = replay(made.path, Thinker(clock, [1]))
    assert (other.same, other.largest) == (0, 1.0)


def test_a_damaged_log_is_rejected_by_its_line(run, tmp_path) -> None:
    path = run().path
    lines = path.read_text().splitlines()
    cut = tmp_path / "cut.jsonl"
    cut.write_text("\n".join(lines[:-1]) + "\n")
    with pytest.raises(ValueError, match="has no end: it is cut off after line 26"):
        read_log(cut)
    record = json.loads(lines[3])
    record["image"]["zlib"] = record["image"]["zlib"][:-8]
    cut.write_text("\n".join([*lines[:3], json.dumps(record), *lines[4:]]))
    with pytest.raises(ValueError, match="damaged at line 4"):
        read_log(cut)
    record = json.loads(lines[3])
    del record["q"]
    cut.write_text("\n".join([*lines[:3], json.dumps(record), *lines[4:]]))
    with pytest.raises(ValueError, match="damaged at line 4"):
        read_log(cut)
    cut.write_text('{"other": 1}\n')
    with pytest.raises(ValueError, match="is not a log of mjx-arm deploy"):
        read_log(cut)
    with pytest.raises(ValueError, match="cannot be read"):
        read_log(tmp_path / "none")


def test_a_log_is_never_overwritten(run, tmp_path) -> None:
    path = run().path
    before = path.read_bytes()
    with pytest.raises(ValueError, match="is there already: give another one"):
        Log(path, {})
    assert path.read_bytes() == before
    with pytest.raises(ValueError, match="cannot be written"):
        Log(tmp_path / "no" / "log", {})


def test_the_clock_of_the_wall_waits_no_longer_than_until_it_is_stopped() -> None:
    from mjx_arm.deploy.clock import WallClock

    clock, stop = WallClock(), threading.Event()
    before = clock.now()
    clock.wait_until(before + 0.05, stop)
    assert clock.now() >= before + 0.05
    stop.set()
    clock.wait_until(before + 3600, stop)
    assert clock.now() < before + 60
