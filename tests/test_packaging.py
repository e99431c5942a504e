"""The project file and the lock agree, and the lock pins and hashes all that it names."""

import re
import tomllib
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import mjx_arm

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
EXTRAS = PROJECT["project"]["optional-dependencies"]
LOCKS = {"cpu": [], "cuda12": EXTRAS["cuda12"], "cuda13": EXTRAS["cuda13"]}
LINUX = {"sys_platform": "linux", "platform_system": "Linux", "platform_machine": "x86_64"}
MACOS = {"sys_platform": "darwin", "platform_system": "Darwin", "platform_machine": "arm64"}
PYTHONS = ("3.11", "3.12", "3.13")


class Pin(NamedTuple):
    requirement: Requirement
    hashes: list[str]


def logical_lines(lock: str) -> list[str]:
    text = (ROOT / "requirements" / f"{lock}.txt").read_text().replace("\\\n", " ")
    lines = [line.strip() for line in text.splitlines()]
    return [line for line in lines if line and not line.startswith("#")]


def pins(lock: str) -> list[Pin]:
    split = [re.split(r"\s+--hash=", line) for line in logical_lines(lock)]
    return [Pin(Requirement(head), hashes) for head, *hashes in split]


def versions(lock: str, python: str, platform: dict[str, str]) -> dict[str, str]:
    """Maps each name that pip would install there to its version."""
    environment = platform | {"python_version": python, "python_full_version": f"{python}.0"}
    found: dict[str, str] = {}
    for requirement, _ in pins(lock):
        if requirement.marker is None or requirement.marker.evaluate(environment):
            name = canonicalize_name(requirement.name)
            assert name not in found, f"{lock} pins {name} twice for Python {python}"
            (specifier,) = requirement.specifier
            found[name] = specifier.version
    return found


@pytest.mark.parametrize("lock", [*LOCKS, "docs", "onnx", "peers"])
def test_lock_pins_and_hashes_everything(lock: str) -> None:
    locked = pins(lock)
    assert locked
    for requirement, hashes in locked:
        (specifier,) = requirement.specifier
        assert specifier.operator == "==", requirement
        assert "*" not in specifier.version, requirement
        assert hashes, requirement
        assert all(re.fullmatch(r"sha256:[0-9a-f]{64}", each) for each in hashes), requirement


@pytest.mark.parametrize("lock", [*LOCKS, "docs", "onnx", "peers"])
def test_lock_names_no_place(lock: str) -> None:
    """No index, host or path: the lock means the same on every machine."""
    text = (ROOT / "requirements" / f"{lock}.txt").read_text()
    assert not re.search(r"://|file:|\s@\s|^\s*/", text, re.MULTILINE)
    assert not [line for line in logical_lines(lock) if line.startswith("-")]


@pytest.mark.parametrize("python", PYTHONS)
@pytest.mark.parametrize(
    ("lock", "platform"),
    [("cpu", LINUX), ("cpu", MACOS), ("cuda12", LINUX), ("cuda13", LINUX)],
    ids=["cpu-linux", "cpu-macos", "cuda12", "cuda13"],
)
def test_lock_satisfies_the_project(lock: str, platform: dict[str, str], python: str) -> None:
    locked = versions(lock, python, platform)
    wanted = [
        *PROJECT["project"]["dependencies"],
        *EXTRAS["dev"],
        *LOCKS[lock],
        *PROJECT["build-system"]["requires"],
    ]
    for requirement in map(Requirement, wanted):
        version = locked[canonicalize_name(requirement.name)]
        assert requirement.specifier.contains(version), f"{requirement}, but {version} is locked"
    assert locked["mujoco"].split(".")[:2] == locked["mujoco-mjx"].split(".")[:2]


@pytest.mark.parametrize("python", PYTHONS)
@pytest.mark.parametrize("lock", ["cuda12", "cuda13"])
def test_gpu_lock_adds_to_the_cpu_lock(lock: str, python: str) -> None:
    """The same versions of all else, so that CPU and GPU run the same code."""
    cpu, gpu = versions("cpu", python, LINUX), versions(lock, python, LINUX)
    assert cpu.items() <= gpu.items()
    assert gpu[f"jax-{lock}-plugin"] == gpu["jaxlib"]


def test_documentation_runs_what_the_tests_run() -> None:
    """The lock of the documentation has the versions of the CPU's lock."""
    cpu, docs = versions("cpu", "3.11", LINUX), versions("docs", "3.11", LINUX)
    for requirement in map(Requirement, [*PROJECT["project"]["dependencies"], *EXTRAS["docs"]]):
        version = docs[canonicalize_name(requirement.name)]
        assert requirement.specifier.contains(version), f"{requirement}, but {version} is locked"
    assert {name: docs[name] for name in cpu.keys() & docs.keys()}.items() <= cpu.items()


def test_warp_is_the_version_mjx_asks_for() -> None:
    asked = [Requirement(each) for each in metadata.requires("mujoco-mjx") or []]
    (wanted,) = [each.specifier for each in asked if each.name == "warp-lang"]
    (extra,) = map(Requirement, EXTRAS["warp"])
    assert extra.specifier == wanted


def test_changelog_has_the_version() -> None:
    headings = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert headings[0] == "Unreleased"
    assert headings[1] == mjx_arm.__version__
