"""Strips and animations."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image

from mjx_arm.reproduce.strips import animation, enlarge, strip


def images(count, edge=8):
    return np.random.default_rng(0).integers(0, 255, (count, edge, edge, 3), np.uint8)


def test_a_strip_has_a_row_of_labels_where_there_are_labels():
    one = Image.open(io.BytesIO(strip([images(3)], [[]])))
    two = Image.open(io.BytesIO(strip([images(3), images(3)], [[], ["a", "b", "c"]])))
    assert one.size == (3 * 8 + 2 * 4, 8)
    assert two.size == (3 * 8 + 2 * 4, 2 * 8 + 4 + 22)


def test_the_same_images_are_the_same_bytes():
    assert strip([images(2)], [["a", "b"]]) == strip([images(2)], [["a", "b"]])
    labels = ["a", "b"]
    assert animation(images(2), labels, milliseconds=80) == animation(
        images(2), labels, milliseconds=80
    )


def test_an_animation_has_its_frames():
    made = Image.open(io.BytesIO(animation(images(3, 32), ["a", "b", "c"], milliseconds=80)))
    assert made.n_frames == 3
    assert made.size == (32, 32)


def test_pixels_are_repeated():
    found = enlarge(np.arange(12, dtype=np.uint8).reshape(1, 2, 2, 3), 4)
    assert found.shape == (1, 4, 4, 3)
    assert (found[0, :2, :2] == [0, 1, 2]).all()
