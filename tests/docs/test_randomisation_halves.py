"""The two command lines that train with one half of a preset of the randomisation each."""

from __future__ import annotations

import dataclasses
import re
import shlex

from doc_pages import ROOT

from mjx_arm.cli.parse import parse
from mjx_arm.envs.randomisation import PRESETS, Ranges

PHYSICS = (
    *("link_mass", "friction", "servo_gain", "servo_damping", "action_delay"),
    *("cube_size", "cube_mass"),
)


def half(base: Ranges, other: Ranges) -> Ranges:
    """The ranges of one preset, with those of the physics from another one."""
    return dataclasses.replace(base, **{name: getattr(other, name) for name in PHYSICS})


def test_the_lines_are_the_halves_of_the_preset_standard():
    text = (ROOT / "docs" / "how-to" / "transfer.md").read_text()
    lines = re.findall(r"^mjx-arm (train .*)$", text, re.MULTILINE)
    image, physics = (parse(shlex.split(line))[0].options.env.randomise.ranges for line in lines)
    off, standard = Ranges(), PRESETS["standard"]
    assert image == half(standard, off)
    assert physics == half(off, standard)
