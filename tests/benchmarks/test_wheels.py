"""The folder of wheels for a machine without a network; no test asks a package index."""

from __future__ import annotations

import pathlib
import sys

import pytest

sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "benchmarks"))
import wheels


def test_parts_are_the_file_again(tmp_path):
    folder, whole = tmp_path / "parts", tmp_path / "whole"
    folder.mkdir()
    whole.mkdir()
    content = {"big-1-py3-none-any.whl": bytes(range(256)) * 10, "small-1-py3-none-any.whl": b"x"}
    for name, data in content.items():
        (folder / name).write_bytes(data)
    parts = [part for path in sorted(folder.iterdir()) for part in wheels.split(path, size=1000)]
    assert len(parts) == 4
    assert max(part.stat().st_size for part in parts) == 1000
    joined = wheels.join(folder, whole)
    assert {path.name: path.read_bytes() for path in joined} == content


def test_what_the_image_has_is_not_fetched():
    names = ("jax", "jaxlib", "orbax-checkpoint", "mujoco", "ml_dtypes", "trimesh", "etils")
    resolved = [{"metadata": {"name": name, "version": "1.0"}} for name in names]
    assert wheels.to_fetch(resolved) == ["etils==1.0", "mujoco==1.0", "trimesh==1.0"]


def test_another_machine_is_named_to_pip():
    options = wheels.platform_options("3.12")
    assert options[:4] == ["--only-binary", ":all:", "--python-version", "3.12"]
    assert "manylinux_2_28_x86_64" in options


def test_a_folder_that_is_not_empty_is_refused(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match="is not empty: give a new or empty folder"):
        wheels.fetch(tmp_path, "3.12", "0.10.2", warp=False)


def test_a_folder_without_wheels_installs_nothing(tmp_path, capsys):
    assert wheels.install(tmp_path) == 2
    assert "holds no wheels" in capsys.readouterr().err
