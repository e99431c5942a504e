"""The command line.

`main` runs a command line within a program; `run` runs one as a process of its own.
"""

from mjx_arm.cli.process import main, run

__all__ = ["main", "run"]
