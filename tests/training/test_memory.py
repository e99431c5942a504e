"""The memory check counts a container's limit, and names the setting that takes the most."""

from __future__ import annotations

import pathlib

import pytest

from mjx_arm.training import memory
from mjx_arm.training.memory import check_memory, free_of_container

PLAN = {"learner": 1, "envs": 2, "obs": 3, "replay": 4, "working": 5}


@pytest.mark.parametrize(
    ("part", "setting"),
    [
        ("learner", "--hidden"),
        ("envs", "--num-envs"),
        ("obs", "--size"),
        ("replay", "--replay-size"),
        ("working", "batch size"),
    ],
)
def test_a_rejection_names_the_setting_that_takes_the_most(part, setting, monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda: 2 * 10**9)
    check_memory(PLAN)
    with pytest.raises(ValueError, match=f"{part} 3.00 GB, and 2.00 GB are free.*{setting}"):
        check_memory(PLAN | {part: 3 * 10**9})


def test_the_devices_of_a_cpu_share_its_memory(monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda: 2 * 10**9)
    plan = PLAN | {"replay": 6 * 10**8}
    check_memory(plan, devices=3)
    with pytest.raises(ValueError, match=r"replay 2\.40 GB, and 2\.00 GB are free"):
        check_memory(plan, devices=4)


def write(root: pathlib.Path, group: str, **files: str) -> None:
    (root / group).mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (root / group / name.replace("__", ".")).write_text(text)


def belongs_to(root: pathlib.Path, line: str) -> pathlib.Path:
    write(root, "proc/self", cgroup=f"3:cpu,cpuacct:/x\n{line}\n")
    return root


def test_the_second_version_of_control_groups_is_read(tmp_path):
    root = belongs_to(tmp_path, "0::/pod/job")
    used = {"memory__current": "700\n", "memory__stat": "anon 5\ninactive_file 200\n"}
    write(root, "sys/fs/cgroup/pod", memory__max="1000\n", **used)
    write(root, "sys/fs/cgroup/pod/job", memory__max="max\n", **used)
    assert free_of_container(root) == 500
    write(root, "sys/fs/cgroup/pod/job", memory__max="600\n", **used)
    assert free_of_container(root) == 100


@pytest.mark.parametrize("group", ["sys/fs/cgroup/memory", "sys/fs/cgroup/memory/docker/1"])
def test_the_first_version_is_read_also_where_only_its_top_is_seen(group, tmp_path):
    root = belongs_to(tmp_path, "4:memory:/docker/1")
    used = {
        "memory__usage_in_bytes": "700\n",
        "memory__stat": "inactive_file 1\ntotal_inactive_file 200\n",
    }
    write(root, group, memory__limit_in_bytes="9223372036854771712\n", **used)
    assert free_of_container(root) is None
    write(root, group, memory__limit_in_bytes="1000\n", **used)
    assert free_of_container(root) == 500


def test_without_control_groups_nothing_is_limited(tmp_path):
    assert free_of_container(tmp_path) is None


def test_the_container_counts_as_the_machine(monkeypatch):
    monkeypatch.setattr(memory, "free_of_container", lambda: 123)
    assert memory.free_memory() == 123
