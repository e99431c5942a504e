"""Driving an arm by a trained agent: the robot's protocol, the control loop, and its log.

Two robots are here: the stand-in, a process of its own behind a loopback socket, and an arm of
Dynamixel servos. Any object with the methods of `Robot` is another one.
"""

from mjx_arm.deploy.clock import Clock, WallClock
from mjx_arm.deploy.guard import Guard, make_guard
from mjx_arm.deploy.log import Log, Replay, read_log, replay
from mjx_arm.deploy.loop import LoopConfig, Outcome, run_loop, stop_on_signals
from mjx_arm.deploy.robot import Frame, Robot, RobotError

__all__ = [
    "Clock",
    "Frame",
    "Guard",
    "Log",
    "LoopConfig",
    "Outcome",
    "Replay",
    "Robot",
    "RobotError",
    "WallClock",
    "make_guard",
    "read_log",
    "replay",
    "run_loop",
    "stop_on_signals",
]
