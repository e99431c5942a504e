"""What would be uploaded passes twine, and installs with its dependencies from nothing."""

from __future__ import annotations

import email
import os
import re
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import mjx_arm

pytest.importorskip("hatchling", reason="the build backend comes with `make setup`")

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
TWINE = "twine==7.0.0"  # earlier ones do not know the metadata that hatchling writes
# Not installed here: jax for another device, a backend for NVIDIA, and gigabytes of other trainers.
METADATA_ONLY = {"cuda12", "cuda13", "peers", "warp"}
USE = """
import importlib, sys
import jax, mjx_arm
assert mjx_arm.__version__ == sys.argv[1], mjx_arm.__version__
env = mjx_arm.make("A", observation="state")
_, state = jax.jit(env.reset)(jax.random.key(0))
print(mjx_arm.__file__, state.physics.qpos.shape)
"""


def run(command: list[object], cwd: Path | None = None) -> str:
    # PYTHONPATH would put the repository before what is installed.
    environment = {name: x for name, x in os.environ.items() if name != "PYTHONPATH"}
    result = subprocess.run(
        list(map(str, command)),
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def archives(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The source distribution and the wheel."""
    folder = tmp_path_factory.mktemp("dist")
    build = (
        "import sys; from hatchling.build import build_sdist, build_wheel; "
        "build_sdist(sys.argv[1]); build_wheel(sys.argv[1])"
    )
    run([sys.executable, "-c", build, folder], cwd=ROOT)
    (sdist,), (wheel,) = folder.glob("*.tar.gz"), folder.glob("*.whl")
    return sdist, wheel


def make_environment(folder: Path) -> Path:
    """An empty environment; returns its Python."""
    venv.create(folder, with_pip=True)
    return folder / "bin" / "python"


def pip(python: Path) -> list[object]:
    return [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]


def without_hashes(lock: str) -> str:
    """The pins of a lock as constraints: with hashes pip would ask for that of the archive."""
    text = (ROOT / "requirements" / f"{lock}.txt").read_text().replace("\\\n", " ")
    pins = (re.sub(r"\s--hash=.*", "", line) for line in text.splitlines())
    return "\n".join(pin for pin in pins if not pin.lstrip().startswith("#"))


def without_marker(requirement: Requirement) -> str:
    """A requirement in one spelling, without the extra that asks for it."""
    extras = ",".join(sorted(requirement.extras))
    return f"{canonicalize_name(requirement.name)}[{extras}]{requirement.specifier}"


def test_version_is_the_same_everywhere(archives: tuple[Path, Path]) -> None:
    sdist, wheel = archives
    version = mjx_arm.__version__
    assert sdist.name == f"mjx_arm-{version}.tar.gz"
    assert wheel.name == f"mjx_arm-{version}-py3-none-any.whl"
    citation = (ROOT / "CITATION.cff").read_text()
    assert re.search(r"^version: \"?([\w.]+)", citation, re.MULTILINE)[1] == version


def test_released_versions_have_a_date() -> None:
    heading = rf"^## {re.escape(mjx_arm.__version__)} \(\d{{4}}-\d{{2}}-\d{{2}}\)$"
    assert re.search(heading, (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)


def test_every_extra_is_in_the_metadata(archives: tuple[Path, Path]) -> None:
    with zipfile.ZipFile(archives[1]) as archive:
        (name,) = [each for each in archive.namelist() if each.endswith(".dist-info/METADATA")]
        metadata = email.message_from_bytes(archive.read(name))
    extras = PROJECT["optional-dependencies"]
    assert set(metadata.get_all("Provides-Extra")) == set(extras)
    required = [Requirement(each) for each in metadata.get_all("Requires-Dist")]
    for extra, wanted in extras.items():
        found = [
            each
            for each in required
            if each.marker is not None
            and each.marker.evaluate({"extra": extra})
            and not each.marker.evaluate({"extra": ""})
        ]
        assert sorted(map(without_marker, found)) == sorted(
            without_marker(Requirement(each)) for each in wanted
        )


def test_source_distribution_has_the_documentation(archives: tuple[Path, Path]) -> None:
    with tarfile.open(archives[0]) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"docs/index.md", "docs/lift.gif", "README.md", "Makefile", "tests/conftest.py"} <= names
    assert not [name for name in names if "_build" in name]


@pytest.mark.slow
def test_twine_accepts_both(archives: tuple[Path, Path], tmp_path: Path) -> None:
    python = make_environment(tmp_path / "twine")
    run([*pip(python), TWINE])
    run([python, "-m", "twine", "check", "--strict", *archives])


# gymnax needs an older gymnasium than the lock has, which the lock of the peers has.
GYMNAX = {"gymnax"}
OTHERS = set(PROJECT["optional-dependencies"]) - METADATA_ONLY - GYMNAX


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "extras", "locks"),
    [("sdist", GYMNAX, ["peers"]), ("wheel", OTHERS, ["cpu", "docs"])],
    ids=["sdist", "wheel"],
)
def test_installs_from_nothing(
    kind: str, extras: set[str], locks: list[str], archives: tuple[Path, Path], tmp_path: Path
) -> None:
    """Both archives, and each extra that can be installed here."""
    python = make_environment(tmp_path / "empty")
    versions: list[object] = []
    for lock in locks:
        # The locks of the peers and of the documentation are for Python 3.11.
        if lock == "cpu" or sys.version_info[:2] == (3, 11):
            path = tmp_path / f"{lock}.txt"
            path.write_text(without_hashes(lock))
            versions += ["--constraint", path]
    archive = archives[("sdist", "wheel").index(kind)]
    run([*pip(python), *versions, f"{archive}[{','.join(sorted(extras))}]"])
    where = run([python, "-W", "error", "-c", USE, mjx_arm.__version__], cwd=tmp_path)
    assert str(tmp_path) in where
    run([python.parent / "mjx-arm", "train", "--help"], cwd=tmp_path)
    run([python, "-m", "pip", "check"])
