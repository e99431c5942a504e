"""The folder of wheels for a machine without a network; no test asks a package index."""

from __future__ import annotations

import importlib.metadata
import pathlib
import subprocess
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
    assert wheels.to_fetch(resolved, "3.12") == ["etils==1.0", "mujoco==1.0", "trimesh==1.0"]


def test_what_does_not_run_on_the_other_python_is_rejected():
    one = {"metadata": {"name": "etils", "version": "1.0", "requires_python": ">=3.13"}}
    assert wheels.to_fetch([one], "3.13") == ["etils==1.0"]
    with pytest.raises(
        ValueError, match=r"etils==1.0 requires Python >=3.13, and --python is 3.12"
    ):
        wheels.to_fetch([one], "3.12")


def test_another_machine_is_named_to_pip():
    options = wheels.platform_options("3.12")
    assert options[:4] == ["--only-binary", ":all:", "--python-version", "3.12"]
    assert "manylinux_2_28_x86_64" in options


def test_a_folder_that_is_not_empty_is_rejected(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match="is not empty: give a new or empty folder"):
        wheels.fetch(tmp_path, "3.12", "0.10.2", warp=False)


def test_a_folder_without_wheels_installs_nothing(tmp_path, capsys):
    assert wheels.install(tmp_path) == 2
    assert "holds no wheels" in capsys.readouterr().err


def test_versions_of_the_image_are_compared_with_the_bounds(tmp_path):
    pyproject = tmp_path / "pyproject.toml"
    listed = ["jax>=0.10,<0.13", "flax>=0.12.6", "optax>=0.2.8", "chex>=0.1.92", "mujoco>=9"]
    pyproject.write_text(f"[project]\ndependencies = {listed}\n")
    image = {"jax": "0.13.0", "flax": "0.12.10", "optax": "0.2.8"}

    def installed(name: str) -> str:
        if name not in image:
            raise importlib.metadata.PackageNotFoundError(name)
        return image[name]

    said = wheels.mismatches(pyproject, installed)
    assert len(said) == 2
    assert "jax 0.13.0 is installed, and pyproject.toml asks for jax<0.13,>=0.10" in said
    assert "chex is not installed, and pyproject.toml asks for chex>=0.1.92" in said


def test_this_environment_is_within_the_bounds():
    assert wheels.mismatches() == []


def test_an_installation_prints_each_mismatch(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "wheels"
    folder.mkdir()
    (folder / "one-1-py3-none-any.whl").write_bytes(b"x")
    done = subprocess.CompletedProcess([], 0)
    monkeypatch.setattr(wheels.subprocess, "run", lambda *_, **__: done)
    monkeypatch.setattr(wheels, "mismatches", lambda: ["jax 1 is installed"])
    assert wheels.install(folder) == 0
    assert "warning: jax 1 is installed" in capsys.readouterr().err
