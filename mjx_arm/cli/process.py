"""The command line as a process: exit status, errors of one line, signals."""

from __future__ import annotations

import contextlib
import io
import os
import signal
import sys
from collections.abc import Sequence
from types import FrameType
from typing import NoReturn

import jax

from mjx_arm.cli.parse import parse
from mjx_arm.training.processes import (
    alone,
    end_together,
    is_loss,
    is_writer,
    lost_sentence,
)
from mjx_arm.training.runner import RunInterruptedError, stop_signals


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line.

    Returns:
      The exit status: 2 for invalid input, a disk that does not take the output or a robot that has
      failed, 130 for a run that was interrupted.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        command, given = parse(arguments)
        # Whatever JAX_NUMPY_RANK_PROMOTION says: it is meant for the user's own programs.
        with jax.numpy_rank_promotion("allow"):
            return command.run(given) or 0
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        print(f"error: {where}{' '.join(str(error.strerror or error).split())}", file=sys.stderr)
        return 2
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" in str(error):
            advice = "give a smaller --replay-size, --num-envs or batch size"
            print(f"error: the device has run out of memory: {advice}", file=sys.stderr)
        elif alone() or not is_loss(error):
            raise
        else:
            print(f"error: {lost_sentence(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except RunInterruptedError as stop:
        if is_writer():
            print(stop, file=sys.stderr)
        return 130


def run(arguments: Sequence[str] | None = None) -> NoReturn:
    """Runs the command line as a process of its own, and ends it.

    Ctrl-C and what schedulers send end it at once, which damages no file; while a run trains, it
    saves first.
    """
    for number in stop_signals():
        signal.signal(number, _stop)
    for stream in (sys.stdout, sys.stderr):
        # A terminal or a log that cannot show a character does not end a run.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    status = main(arguments)
    end_together(status)
    sys.exit(status)


def _stop(number: int, frame: FrameType | None) -> NoReturn:
    """Ends the process at once.

    A KeyboardInterrupt would be lost inside of a compilation, or leave one running that crashes
    when Python shuts down around it.
    """
    # Not by print, which the signal may have interrupted.
    if os.isatty(1):
        os.write(1, b"\x1b[?25h")  # the cursor, which a progress bar hides
    with contextlib.suppress(OSError):  # the terminal may be gone
        os.write(2, b"stopped; a training that has begun continues with --resume and its folder\n")
    os._exit(128 + number)
