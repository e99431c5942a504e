"""A run is continued only as what it was, by one process at a time, and can be asked to stop."""

from __future__ import annotations

import concurrent.futures
import dataclasses
import io
import json
import pathlib
import random
import shutil
import signal
import subprocess
import sys
import unittest.mock

import jax
import pytest
from rich.console import Console

from mjx_arm import load_agent, load_scene, resume, train
from mjx_arm.cli import main
from mjx_arm.config import train_config
from mjx_arm.report.metrics import keep_metrics, read_metrics
from mjx_arm.report.progress import make_console
from mjx_arm.training import runner
from mjx_arm.training.evaluate import Evaluation
from mjx_arm.training.run_folder import load_run, locked, save_run
from mjx_arm.training.runner import RunInterruptedError, _Interruption

CONFIG = train_config(
    observation="state", physics="native", num_envs=4, replay_size=400, batch_size=8,
    learning_starts=40, chunk_steps=100, total_steps=200, max_steps=25, hidden=16,
    select_every=100, select_episodes=2, scene="desk.xml",
)  # fmt: skip


def quiet() -> Console:
    return Console(file=io.StringIO())


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> pathlib.Path:
    """A folder with a scene and a run in it, which a thread of a process has trained."""
    home = tmp_path_factory.mktemp("home")
    (home / "desk.xml").write_text(load_scene("arm_cube").xml)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(home)
        # What would have to be compiled, or drawn, beside the training.
        result = Evaluation(2, 1, 0.5, (0.0, 1.0), 9.0, {})
        patch.setattr(runner, "evaluate", lambda *args, **options: result)
        patch.setattr(runner, "plot_curves", lambda *args, **options: [])
        patch.setattr(runner, "record_episode", lambda *args, **options: unittest.mock.MagicMock())
        patch.setattr(runner, "render_episode", lambda *args: [])
        patch.setattr(runner, "write_video", lambda *args: None)
        # Only the main thread may set handlers of signals.
        with concurrent.futures.ThreadPoolExecutor(1) as pool:
            pool.submit(train, CONFIG, "run", eval_episodes=2, console=quiet()).result()
    return home


@pytest.fixture
def copy(home, tmp_path, monkeypatch) -> pathlib.Path:
    shutil.copytree(home, tmp_path / "home")
    monkeypatch.chdir(tmp_path / "home")
    return tmp_path / "home"


def rejection(folder: pathlib.Path | str, capsys) -> str:
    capsys.readouterr()
    assert main(["train", "--resume", str(folder)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    return error


def test_a_run_leaves_an_agent_with_its_evaluation(home):
    evaluation = json.loads((home / "run/evaluation.json").read_text())
    assert load_agent(home / "run", scene="stored").evaluation == evaluation
    assert evaluation["episodes"] == 2


def test_an_edited_option_is_named(copy, capsys):
    path = copy / "run/config.json"
    path.write_text(path.read_text().replace('"gamma": 0.99', '"gamma": 0.9'))
    assert rejection("run", capsys) == (
        "error: run/config.json has changed since the run wrote it: gamma was 0.99 and is now 0.9; "
        "restore it\n"
    )


def test_flipped_bits_in_the_configuration_are_all_found(copy, capsys):
    path, rng = copy / "run/config.json", random.Random(0)
    content = path.read_bytes()
    # Most of the file is the scene: half of the bits are in the options.
    places = [rng.randrange(8 * 2_500) for _ in range(25)]
    places += [rng.randrange(8 * len(content)) for _ in range(25)]
    for place in places:
        flipped = bytearray(content)
        flipped[place // 8] ^= 1 << place % 8
        path.write_bytes(flipped)
        assert "config.json" in rejection("run", capsys)


def test_the_configuration_of_another_run_is_rejected(copy, capsys):
    run = load_run(copy / "run")
    save_run(copy / "run", dataclasses.replace(run, run_id="another"))
    assert "is a checkpoint of another run" in rejection("run", capsys)


def test_a_run_in_an_edited_scene_is_not_continued(copy, capsys):
    scene = copy / "desk.xml"
    scene.write_text(scene.read_text().replace("</mujoco>", "\n</mujoco>"))
    assert rejection("run", capsys) == (
        "error: the scene 'desk.xml' has changed since the run in run was started: restore it\n"
    )


def test_a_run_is_continued_elsewhere_and_saves_when_a_scheduler_asks(copy, monkeypatch):
    monkeypatch.chdir("/")

    def ask(rows, state):
        signal.raise_signal(signal.SIGTERM)

    with pytest.raises(RunInterruptedError, match=r"saved; continue with: .* --resume "):
        resume(copy / "run", total_steps=400, on_chunk=ask, console=quiet())
    assert load_run(copy / "run").config.total_steps == 400
    assert [row["env_steps"] for row in read_metrics(copy / "run")] == [100, 200, 300]
    assert sorted(path.name for path in (copy / "run/checkpoints").iterdir()) == [
        f"{50:012d}",
        f"{75:012d}",
    ]


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1"])
def test_a_signal_asks_to_stop(name, tmp_path, capfd):
    number = getattr(signal, name)
    before = signal.signal(number, signal.default_int_handler)
    try:
        with _Interruption(tmp_path) as interruption:
            assert not interruption.asked
            signal.raise_signal(number)
            assert interruption.asked
            if name == "SIGINT":
                with pytest.raises(KeyboardInterrupt):
                    signal.raise_signal(number)
                first, second = capfd.readouterr().err.splitlines()
                assert first.startswith("saving after this chunk; a second Ctrl-C ends the run")
                assert second.startswith("steps since the newest checkpoint are lost; continue")
                assert second.endswith(f"train --resume {tmp_path}")
            else:
                signal.raise_signal(number)  # schedulers may send theirs more than once
        assert signal.getsignal(number) == signal.default_int_handler
    finally:
        signal.signal(number, before)


def test_a_hangup_that_is_ignored_stays_ignored(tmp_path):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with _Interruption(tmp_path) as interruption:
            signal.raise_signal(signal.SIGHUP)
            assert not interruption.asked
    finally:
        signal.signal(signal.SIGHUP, before)


WAITS = """
import signal, sys, time
from mjx_arm.cli import process
def wait(arguments):
    print("started", flush=True)
    time.sleep(60)
process.parse = wait
process.run(["train"])
"""


def test_a_signal_before_training_ends_the_process_at_once():
    process = subprocess.Popen(
        [sys.executable, "-c", WAITS], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "started\n"
    process.send_signal(signal.SIGTERM)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGTERM
    assert error == "stopped; a training that has begun continues with --resume and its folder\n"


HOLDS = """
import pathlib, sys, filelock
with filelock.FileLock(pathlib.Path(sys.argv[1]) / ".lock"):
    print("locked", flush=True)
    sys.stdin.read()
"""


def test_a_folder_has_one_process_at_a_time(copy, capsys):
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDS, "run"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stdout.readline() == "locked\n"
    assert rejection("run", capsys) == (
        "error: run is in use by another process: wait until it ends, or give another folder\n"
    )
    process.communicate("", timeout=60)
    with locked(copy / "run"):
        pass


@pytest.mark.parametrize("command", ["eval", "play", "export"])
def test_a_run_of_version_0_1_is_named_as_one(command, tmp_path, capsys):
    """Its agents have other names, so that it seems to hold none."""
    (tmp_path / "config.json").write_text('{"env": "B", "physics": "native", "num_envs": 64}')
    assert main([command, str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {tmp_path / 'config.json'} was written by mjx_arm 0.1, ")
    assert error.count("\n") == 1


@pytest.mark.parametrize("damage", ["{", "[1]", '{"env_steps": "x", "wall_s": 1}', "\xff", "{}"])
def test_a_damaged_line_of_metrics_is_named(damage, copy):
    path = copy / "run/metrics.jsonl"
    lines = path.read_bytes().splitlines()
    lines[1] = damage.encode("latin-1")
    path.write_bytes(b"\n".join(lines) + b"\n")
    for read in (read_metrics, lambda folder: keep_metrics(folder, 100)):
        with pytest.raises(ValueError, match=r"metrics.jsonl, line 2 is damaged"):
            read(copy / "run")


@pytest.mark.parametrize("value", [0, -1, 2.5, "6", True, None, float("nan")])
def test_a_number_of_episodes_that_is_none_is_rejected(value, copy):
    with pytest.raises(ValueError, match="eval_episodes must be a whole number of at least 1, got"):
        resume("run", eval_episodes=value, console=quiet())


@pytest.mark.parametrize("value", [0.0, 1.5, "1", True, float("nan"), float("inf")])
def test_a_rate_to_stop_at_that_is_none_is_rejected(value, copy):
    with pytest.raises(ValueError, match="stop_at must be a finite number above 0 and of at most"):
        resume("run", stop_at=value, console=quiet())


def test_a_terminal_without_a_character_gets_a_question_mark(monkeypatch):
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding="ascii"))
    console = make_console()
    console.print("ε 0.10")
    sys.stdout.flush()
    assert raw.getvalue() == b"? 0.10\n"


def test_training_without_compilation_is_rejected(capsys):
    with jax.disable_jit():
        assert main(["train", "--preset", "pixels"]) == 2
    assert "JAX_DISABLE_JIT must be unset" in capsys.readouterr().err


@pytest.mark.parametrize("failure", [RuntimeError("no cuda"), AssertionError()])
def test_a_device_that_is_not_there_is_one_sentence(failure, capsys, monkeypatch):
    def devices(*args):
        raise failure

    monkeypatch.setattr(jax, "devices", devices)
    for command in (["train"], ["eval", "some"], ["play", "some"]):
        assert main(command) == 2
        error = capsys.readouterr().err
        assert error.endswith("finds no device to run on: give one that is here\n")
        assert error.count("\n") == 1
