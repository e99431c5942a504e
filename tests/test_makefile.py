"""What the Makefile rejects, and when it builds the environment again."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
BUILDS = "--require-hashes"


def make(*arguments: str) -> subprocess.CompletedProcess[str]:
    # MAKEFLAGS and the like are there when `make test` runs this, and would be inherited.
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("MAKE", "MFLAGS"))}
    return subprocess.run(
        ["make", *arguments], cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )


@pytest.fixture
def venv(tmp_path: Path) -> Path:
    """Half an environment: the folder that `python -m venv` leaves, without a stamp."""
    folder = tmp_path / "venv"
    folder.mkdir()
    (folder / "pyvenv.cfg").touch()
    return folder


@pytest.mark.parametrize("gpu", ["rocm", "cuda", "cuda12 cuda13", "cpu"])
def test_unknown_gpu_is_rejected(gpu: str, venv: Path) -> None:
    result = make("setup", f"GPU={gpu}", f"VENV={venv}")
    assert result.returncode == 2
    assert f"GPU is cuda12 or cuda13, or left out for the CPU, and not '{gpu}'" in result.stderr


@pytest.mark.parametrize("version", ["(3, 10)", "(3, 14)", None])
def test_other_python_is_rejected(version: str | None, venv: Path, tmp_path: Path) -> None:
    python = tmp_path / "python-other"
    if version is not None:
        patch = f"import sys; sys.version_info = {version}; exec(sys.argv.pop(1))"
        python.write_text(f'#!/bin/sh\nshift\nexec "{sys.executable}" -c "{patch}" "$@"\n')
        python.chmod(0o755)
    result = make("setup", f"PYTHON={python}", f"VENV={venv}")
    assert result.returncode == 2
    assert f"Python 3.11, 3.12 or 3.13 is needed, and '{python}' is another" in result.stderr
    assert list(venv.iterdir()) == [venv / "pyvenv.cfg"]


def test_folder_that_is_no_environment_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").touch()
    result = make("setup", f"PYTHON={sys.executable}", f"VENV={tmp_path}")
    assert result.returncode == 2
    assert "is no virtual environment" in result.stderr
    assert (tmp_path / "thesis.tex").exists()


@pytest.mark.parametrize("target", ["setup", "train", "play", "test", "test-slow"])
def test_half_an_environment_is_built_again(target: str, venv: Path) -> None:
    assert BUILDS in make("--dry-run", target, f"VENV={venv}").stdout


@pytest.mark.parametrize("target", ["setup", "train", "play", "test", "test-slow"])
def test_whole_environment_is_built_again_only_for_a_newer_lock(target: str, venv: Path) -> None:
    stamp = venv / ".locked-cpu"
    stamp.touch()
    assert BUILDS not in make("--dry-run", target, f"VENV={venv}").stdout
    os.utime(stamp, (0, 0))
    assert BUILDS in make("--dry-run", target, f"VENV={venv}").stdout


def test_documentation_has_a_lock_of_its_own_and_is_checked(venv: Path) -> None:
    assert f"{BUILDS} --only-binary :all: -r requirements/docs.txt" in (
        make("--dry-run", "docs", f"DOCS={venv}").stdout
    )
    (venv / ".locked").touch()
    output = make("--dry-run", "docs", f"DOCS={venv}").stdout
    assert BUILDS not in output
    assert output.index("--fail-on-warning") < output.index("docs/check_site.py")
    (venv / ".locked-cpu").touch()
    site = re.search(r"check_site\.py (\S+)", output)[1]
    lines = make("--dry-run", "test-docs", f"VENV={venv}").stdout.splitlines()
    assert lines[-1] == f"{venv}/bin/python docs/check_browser.py {site}"


def test_gpu_environment_is_kept_by_all_but_setup(venv: Path) -> None:
    (venv / ".locked-cuda12").touch()
    assert BUILDS not in make("--dry-run", "train", f"VENV={venv}").stdout
    assert BUILDS not in make("--dry-run", "setup", "GPU=cuda12", f"VENV={venv}").stdout
    other = make("--dry-run", "train", "GPU=cuda13", f"VENV={venv}").stdout
    assert f"{BUILDS} --only-binary :all: -r requirements/cuda13.txt" in other
    plain = make("--dry-run", "setup", f"VENV={venv}").stdout
    assert f"{BUILDS} --only-binary :all: -r requirements/cpu.txt" in plain


def test_play_records_an_agent(venv: Path) -> None:
    (venv / ".locked-cpu").touch()
    lines = make("--dry-run", "play", f"VENV={venv}", "ARGS=--env A").stdout.splitlines()
    assert lines[-1] == f"{venv}/bin/mjx-arm play agent-b --env A"


def test_the_peers_tests_are_all_in_the_files_that_are_run_for_them() -> None:
    """The others may import what the peers' environment lacks, so they are not even read there."""
    named = make("--print-data-base", "--question", "help").stdout
    places = next(line for line in named.splitlines() if line.startswith("PEERS_TESTS := "))
    folders = [ROOT / place for place in places.removeprefix("PEERS_TESTS := ").split()]
    marked = [path for path in (ROOT / "tests").rglob("*.py") if "mark.peers" in path.read_text()]
    marked.remove(Path(__file__))
    assert marked
    for path in marked:
        assert any(path.is_relative_to(folder) for folder in folders), path
