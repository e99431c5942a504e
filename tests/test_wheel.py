"""The built wheel works outside the repository, scenes included."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

pytest.importorskip("hatchling", reason="the build backend comes with `make setup`")

ROOT = Path(__file__).parents[1]
PIP = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", "--no-cache-dir"]
USE = """
import pathlib, mjx_arm
mjx_arm.load_scene("arm_cube")
print(pathlib.Path(mjx_arm.__file__).parent)
"""


def run(command: list[str], **options: object) -> str:
    result = subprocess.run(command, capture_output=True, text=True, check=False, **options)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from the source distribution, so that both are tried."""
    folder = tmp_path_factory.mktemp("dist")
    build = "import sys; from hatchling.build import build_sdist; print(build_sdist(sys.argv[1]))"
    sdist = folder / run([sys.executable, "-c", build, str(folder)], cwd=ROOT).split()[-1]
    offline = ["--no-deps", "--no-build-isolation", "--no-index"]
    run([*PIP, "wheel", *offline, "--wheel-dir", str(folder), str(sdist)])
    (built,) = folder.glob("*.whl")
    return built


def test_wheel_holds_the_package_and_no_more(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        (info,) = {name.split("/")[0] for name in names} - {"mjx_arm"}
        entry_points = archive.read(f"{info}/entry_points.txt").decode()
    scenes = {path.relative_to(ROOT).as_posix() for path in (ROOT / "xml").rglob("*.xml")}
    assert scenes
    assert {f"mjx_arm/{scene}" for scene in scenes} <= names
    assert info.endswith(".dist-info")
    assert f"{info}/licenses/LICENSE" in names
    assert "mjx-arm = mjx_arm.cli:run" in entry_points


def test_scene_loads_from_the_installed_wheel(wheel: Path, tmp_path: Path) -> None:
    site, elsewhere = tmp_path / "site", tmp_path / "elsewhere"
    elsewhere.mkdir()
    run([*PIP, "install", "--no-deps", "--no-index", "--target", str(site), str(wheel)])
    environment = os.environ | {"PYTHONPATH": str(site)}
    where = run([sys.executable, "-c", USE], cwd=elsewhere, env=environment)
    assert Path(where.splitlines()[-1]).resolve() == (site / "mjx_arm").resolve()
