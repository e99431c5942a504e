"""Trains an arm from pixels: `python train.py --help`."""

import sys

from mjx_arm.cli import run

if __name__ == "__main__":
    run(["train", *sys.argv[1:]])
