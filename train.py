"""Trains an arm from pixels: `python train.py --help`."""

import sys

from mjx_arm.cli import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
