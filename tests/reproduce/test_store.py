"""The files of the page's folder."""

from __future__ import annotations

import pytest

from mjx_arm.reproduce.store import Measured, Store


@pytest.fixture
def store(tmp_path):
    made = Store(tmp_path / "page")
    made.prepare()
    return made


def measured(**changes):
    values = {
        "name": "cell",
        "command": "mjx-arm reproduce --only cell",
        "inputs": {"episodes": 3},
        "result": {"rate": 0.5, "list": [1, 2]},
        "pictures": ("cell.png",),
        "machine": {"cpu": "one"},
        "seconds": 1.5,
        "date": "2026-01-01",
    }
    return Measured(**(values | changes))


def test_a_cell_is_read_as_it_was_written(store):
    store.write(measured(), {"cell.png": b"picture"})
    assert store.read("cell") == measured()
    assert store.picture("cell.png") == b"picture"
    assert store.read("other") is None


def test_a_cell_without_its_picture_counts_as_missing(store):
    store.write(measured(), {"cell.png": b"picture"})
    (store.folder / "pictures" / "cell.png").unlink()
    assert store.read("cell") is None


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"format": 1, "pictures": []}'])
def test_a_damaged_file_is_named(store, content):
    path = store.folder / "cells" / "cell.json"
    path.write_text(content)
    with pytest.raises(ValueError, match=r"cell\.json is damaged: remove it"):
        store.read("cell")


def test_a_number_that_is_none_is_not_written(store):
    with pytest.raises(ValueError, match="not JSON compliant"):
        store.write(measured(result={"rate": float("nan")}, pictures=()), {})
    assert store.read("cell") is None
