from __future__ import annotations

import pathlib

import numpy as np
import pytest
from PIL import Image

from mjx_arm.tools.textures import TEXTURES, write_textures

XML = pathlib.Path(__file__).parents[2] / "xml"


@pytest.mark.parametrize("name", TEXTURES)
def test_the_files_of_the_scene_are_what_the_command_writes(name: str) -> None:
    image = np.asarray(Image.open(XML / f"desk_{name}.png").convert("RGB"))
    made = TEXTURES[name]()
    assert made.dtype == np.uint8
    assert made.shape[0] == made.shape[1] in (128, 256)
    np.testing.assert_array_equal(image, made)


@pytest.mark.parametrize("name", sorted(set(TEXTURES) - {"carton", "checker"}))
def test_a_texture_continues_at_its_opposite_edges(name: str) -> None:
    image = TEXTURES[name]().astype(float)
    for axis in (0, 1):
        seam = np.abs(np.take(image, 0, axis) - np.take(image, -1, axis)).mean()
        inside = np.abs(np.diff(image, axis=axis)).mean(axis=(1 - axis, 2)).max()
        assert seam <= inside + 1


def test_the_files_are_small_and_named(tmp_path: pathlib.Path) -> None:
    paths = write_textures(tmp_path)
    assert [path.name for path in paths] == [f"desk_{name}.png" for name in TEXTURES]
    # An agent's file carries those of its scene.
    assert sum(path.stat().st_size for path in paths) < 400_000
