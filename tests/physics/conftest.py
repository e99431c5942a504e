from __future__ import annotations

from collections.abc import Iterator

import pytest
from physics_lab import BACKENDS, Lab, LongRun, make_lab, make_long_run
from scene_ids import TaskIds, resolve_task

from mjx_arm.scene import Scene, load_scene


@pytest.fixture(scope="session")
def scene() -> Scene:
    return load_scene("arm_cube")


@pytest.fixture(scope="session")
def ids(scene: Scene) -> TaskIds:
    return resolve_task(scene)


@pytest.fixture(scope="session", params=BACKENDS)
def lab(request: pytest.FixtureRequest) -> Lab:
    return make_lab(request.param)


@pytest.fixture(scope="session")
def labs() -> dict[str, Lab]:
    return {backend: make_lab(backend) for backend in BACKENDS}


@pytest.fixture(scope="session", params=BACKENDS)
def long_run(request: pytest.FixtureRequest) -> LongRun:
    return make_long_run(request.param)


@pytest.fixture(scope="session")
def long_runs() -> dict[str, LongRun]:
    return {backend: make_long_run(backend) for backend in BACKENDS}


@pytest.fixture
def in_empty_folder(tmp_path, monkeypatch) -> Iterator[None]:
    """Runs a test in an empty folder, and fails it if something is left there."""
    monkeypatch.chdir(tmp_path)
    yield
    assert not list(tmp_path.iterdir())
