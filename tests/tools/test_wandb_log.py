"""Weights & Biases in its offline mode, which needs no account and no network."""

from __future__ import annotations

import json
import math
import pathlib
import sys
import time
from collections.abc import Iterator
from typing import Any

import pytest
from made_runs import make_run, row

from mjx_arm.cli import main
from mjx_arm.tools.wandb_log import WandbLog
from mjx_arm.training.run_folder import load_run

_BLOCK, _WHOLE, _LAST = 32_768, 1, 4


@pytest.fixture(autouse=True)
def offline(monkeypatch, tmp_path):
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("WANDB_CONFIG_DIR", str(tmp_path / "config"))


def records(path: pathlib.Path) -> Iterator[bytes]:
    """The records of a log in LevelDB's format, after wandb's own header of 7 bytes."""
    content, at, record = path.read_bytes(), 7, b""
    while at + 7 <= len(content):
        left = _BLOCK - at % _BLOCK
        if left < 7:
            at += left
            continue
        # Of each piece: 4 bytes of checksum, 2 of length, 1 that says which piece it is.
        length, kind = int.from_bytes(content[at + 4 : at + 6], "little"), content[at + 6]
        record += content[at + 7 : at + 7 + length]
        at += 7 + length
        if kind in (_WHOLE, _LAST):
            yield record
            record = b""


def wait_for_the_end(path: pathlib.Path) -> list[bytes]:
    """The records of a log, once the process that writes it has written the last one."""
    from wandb.proto import wandb_internal_pb2

    for _ in range(600):
        found = list(records(path))
        last = wandb_internal_pb2.Record()
        last.ParseFromString(found[-1] if found else b"")
        if last.WhichOneof("record_type") == "exit":
            return found
        time.sleep(0.1)
    raise AssertionError(f"{path} was not finished")


def read_log(path: pathlib.Path) -> dict[str, Any]:
    """What an offline run holds: rows of metrics, its summary, configuration and name."""
    from wandb.proto import wandb_internal_pb2

    found: dict[str, Any] = {"rows": [], "summary": {}, "config": {}, "name": ""}
    for data in wait_for_the_end(path):
        record = wandb_internal_pb2.Record()
        record.ParseFromString(data)
        kind = record.WhichOneof("record_type")
        if kind == "history":
            found["rows"].append(_items(record.history.item))
        elif kind == "summary":
            found["summary"] |= _items(record.summary.update)
        elif kind == "run":
            found["name"] = record.run.display_name
            found["config"] |= _items(record.run.config.update)
    return found


def _items(items: Any) -> dict[str, Any]:
    return {item.key or ".".join(item.nested_key): json.loads(item.value_json) for item in items}


@pytest.mark.slow
def test_an_offline_run_has_metrics_options_and_results(tmp_path):
    folder = tmp_path / "run"
    make_run(folder, (90, 80), seed=3)
    first, second = row(100, rate=None), row(200, rate=0.5)
    first["selection_rate"] = math.nan
    with WandbLog(folder) as log:
        log([first, first], None)
        log([second, {**second, "loss": 7.0}], None)
    for seed, loss, successes in ((3, 0.02, 90), (4, 7.0, 80)):
        (path,) = (folder / f"seed-{seed}" / "wandb").glob("offline-run-*/run-*.wandb")
        assert f"{load_run(folder).run_id}-{seed}" in path.name
        found = read_log(path)
        rows = [each for each in found["rows"] if "loss" in each]
        assert [each["env_steps"] for each in rows] == [100, 200]
        assert "selection_rate" not in rows[0]
        assert (rows[1]["selection_rate"], rows[1]["loss"]) == (0.5, loss)
        assert found["name"] == f"run/seed-{seed}"
        assert found["config"]["seed"] == seed
        assert found["summary"]["evaluation"]["successes"] == successes


@pytest.mark.long
def test_a_training_is_logged_and_a_resumed_one_continues_there(tmp_path):
    folder = tmp_path / "run"
    options = (
        "--preset state --physics native --num-envs 4 --replay-size 400 --batch-size 8 "
        "--learning-starts 40 --chunk-steps 80 --max-steps 15 --hidden 16 --select-every 0"
    )
    ends = ["--eval-episodes", "2", "--no-video", "--wandb"]
    first = ["train", *options.split(), "--total-steps", "160", "--out", str(folder), *ends]
    assert main(first) == 0
    assert main(["train", "--resume", str(folder), "--total-steps", "240", *ends]) == 0
    logs = sorted((folder / "wandb").glob("offline-run-*/run-*.wandb"))
    rows = [each for log in logs for each in read_log(log)["rows"]]
    assert [each["env_steps"] for each in rows if "loss" in each] == [80, 160, 240]
    assert len({log.name for log in logs}) == 1
    media = [each["policy._type"] for each in rows if "policy._type" in each]
    assert media == ["video-file", "video-file"]


def test_nothing_is_logged_before_the_first_chunk(tmp_path):
    with WandbLog(tmp_path):
        pass
    assert not (tmp_path / "wandb").exists()


def test_a_missing_extra_is_named(capsys, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "wandb", None)
    monkeypatch.chdir(tmp_path)
    assert main(["train", "--preset", "pixels", "--wandb"]) == 2
    assert (
        "--wandb needs the extra 'wandb': pip install 'mjx-arm[wandb]'" in capsys.readouterr().err
    )
    assert list(tmp_path.iterdir()) == []
