"""`python -m mjx_arm`: the command line."""

from mjx_arm.cli import run

run()
