from __future__ import annotations

import concurrent.futures
import contextlib
import io
import json
import pathlib
import subprocess
import sys

import flax.traverse_util
import imageio.v3 as imageio
import imageio_ffmpeg
import jax
import numpy as np
import pytest
from tensorboardX.proto.event_pb2 import Event

from mjx_arm.cli import main
from mjx_arm.config import (
    TrainConfig,
    dump_config,
    parse_config,
    set_train_options,
    train_config,
)
from mjx_arm.options import flat_names
from mjx_arm.presets import PRESETS
from mjx_arm.report.metrics import read_metrics
from mjx_arm.scene import SceneSource, load_scene
from mjx_arm.training import runner
from mjx_arm.training.agent import load_agent, read_agent, save_agent
from mjx_arm.training.run_folder import (
    SavedRun,
    choose_run_folder,
    load_config,
    new_run_folder,
    save_run,
)

TINY = [
    *(
        "--preset",
        "pixels",
        "--physics",
        "native",
        "--num-envs",
        "4",
        "--size",
        "16",
        "16",
        "--replay-size",
        "400",
    ),
    *("--batch-size", "8", "--learning-starts", "40", "--chunk-steps", "200"),
    *("--total-steps", "400", "--max-steps", "25", "--hidden", "16", "--eval-episodes", "6"),
    *("--select-every", "200", "--select-episodes", "3"),
]


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory) -> pathlib.Path:
    folder = tmp_path_factory.mktemp("run") / "tiny"
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        assert main(["train", *TINY, "--no-video", "--out", str(folder)]) == 0
    (folder.parent / "output.txt").write_text(output.getvalue())
    return folder


def test_a_run_leaves_everything(run_folder):
    names = {path.name for path in run_folder.iterdir()}
    assert names == {
        *("config.json", "metrics.jsonl", "tensorboard", "evaluation.json"),
        *("last.safetensors", "best.safetensors"),
        *("checkpoints", ".lock"),
        *("figure3.png", "learning.png", "report.html"),
    }
    rows = read_metrics(run_folder)
    assert [row["env_steps"] for row in rows] == [200, 400]
    assert json.loads((run_folder / "evaluation.json").read_text())["episodes"] == 6
    config = load_config(run_folder)
    assert (config.total_steps, config.env.physics) == (400, "native")


def test_the_folder_is_named_before_the_preset_and_the_device(run_folder):
    lines = (run_folder.parent / "output.txt").read_text().splitlines()
    assert lines[:2] == [f"run folder: {run_folder}", "preset: pixels"]
    assert lines[2].startswith("device: ")


def test_a_run_that_is_rejected_names_a_folder_and_makes_none(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["train", *TINY, "--init-from", "nowhere"]) == 2
    said = capsys.readouterr()
    assert said.out.startswith("run folder: runs/")
    assert "nowhere is not a run folder and not an agent" in said.err
    assert list(tmp_path.iterdir()) == []


def test_a_chosen_folder_that_another_run_has_made_is_replaced(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    chosen = choose_run_folder("A")
    assert not chosen.exists()
    assert new_run_folder("A", chosen) == chosen
    other = new_run_folder("A", chosen)
    assert other != chosen
    assert other.is_dir()


@pytest.mark.parametrize(("backend", "preset"), [("cpu", "fast"), ("gpu", "gpu"), ("tpu", "gpu")])
def test_the_default_preset_follows_the_device_and_is_printed(
    backend, preset, tmp_path, monkeypatch, capsys
):
    def stop(config, *rest):
        assert config == PRESETS[preset]
        raise ValueError("enough")

    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setattr(runner, "_prepare", stop)
    assert main(["train", "--out", str(tmp_path / "run")]) == 2
    lines = capsys.readouterr().out.splitlines()
    assert lines == [f"run folder: {tmp_path / 'run'}", f"preset: {preset}"]


def test_runs_that_start_in_the_same_second_have_folders_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        folders = list(pool.map(new_run_folder, ["A"] * 24))
    assert len(set(folders)) == 24
    assert {path.parent for path in folders} == {pathlib.Path("runs")}


def test_no_folder_for_a_run_is_a_sentence(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").write_text("")
    with pytest.raises(ValueError, match=r"runs.* cannot be made .*: give --out another folder"):
        new_run_folder("A")


def read_video(path: pathlib.Path) -> np.ndarray:
    """Frames of a video of 384 by 768; imageio's own reader leaves its pipes open."""
    decode = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-i", str(path)]
    raw = [*decode, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    frames = subprocess.run(raw, capture_output=True, check=True).stdout
    return np.frombuffer(frames, np.uint8).reshape(-1, 384, 768, 3)


def test_tensorboard_reads_the_events(run_folder):
    (path,) = (run_folder / "tensorboard").iterdir()
    content, events = path.read_bytes(), []
    while content:
        # A record: its length in 8 bytes, 4 of checksum, itself, 4 of checksum.
        length = int.from_bytes(content[:8], "little")
        events.append(Event.FromString(content[12 : 12 + length]))
        content = content[16 + length :]
    values = {(event.step, v.tag): v.simple_value for event in events for v in event.summary.value}
    for row in read_metrics(run_folder):
        for name in ("loss", "epsilon", "steps_per_s"):
            assert values[row["env_steps"], name] == pytest.approx(row[name], rel=1e-6)


def test_the_video_shows_the_scene_and_the_agents_view(run_folder, tmp_path):
    path = tmp_path / "policy.mp4"
    assert main(["play", str(run_folder), "--out", str(path), "--max-steps", "25"]) == 0
    frames = read_video(path)
    assert len(frames) == 26
    assert frames.shape[1:] == (384, 768, 3)
    for half in (frames[0, :, :384], frames[0, :, 384:]):
        assert half.std() > 5


def test_the_curves_are_pictures(run_folder):
    for name in ("figure3.png", "learning.png"):
        assert np.asarray(imageio.imread(run_folder / name)).std() > 5


def test_the_agent_acts(run_folder):
    agent = load_agent(run_folder)
    obs, _ = agent.env.reset(jax.random.key(0))
    assert 0 <= int(agent.act(obs, jax.random.key(0))) < 14
    actions = {int(agent.act(obs, jax.random.key(k), epsilon=1.0)) for k in range(20)}
    assert len(actions) > 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--env", "C"], "env must be one of A, B, got 'C'"),
        (["--physics", "bullet"], "physics must be one of auto, native, mjx, mjx-warp, got 'bull"),
        (["--num-envs", "0"], "num_envs must be a whole number of at least 1, got 0"),
        (["--num-envs", "-3"], "num_envs must be a whole number of at least 1, got -3"),
        (["--batch-size", "0"], "batch_size must be a whole number of at least 1, got 0"),
        (["--replay-size", "32"], "replay_size must be at least (n_step + 1) * num_envs = 384"),
        (
            ["--num-envs", "1", "--replay-size", "32"],
            "replay_size must be at least batch_size = 64",
        ),
        (["--replay-size", "100000000", "--storage", "pixels"], "give a smaller --replay-size"),
        (
            ["--replay-size", "1000000000000"],
            "replay_size must be a whole number of at least 1 and",
        ),
        (["--reward", "candy"], "unknown reward 'candy'"),
        (["--task", "pour"], "unknown task 'pour'"),
        (["--algorithm", "sarsa"], "unknown algorithm 'sarsa'"),
        (["--scene", "kitchen"], "unknown scene 'kitchen'"),
        (["--size", "0", "64"], "size must be a tuple of two values, each a whole number of at le"),
        (["--preset", "slow"], "unknown preset 'slow'"),
        (["--preset"], "preset must be text, got nothing"),
        (["--size", "4"], "size must be a tuple of two values, each a whole number of at least 1"),
        (["--camera"], "camera must name at least one camera, got ()"),
        (["--colour", "red"], "unknown option '--colour'"),
        (["--num-envs", "many"], "--num-envs must be a whole number of at least 1, got 'many'"),
        (["--num-seeds", "0"], "num_seeds must be a whole number of at least 1, got 0"),
        (["--select-every", "-1"], "select_every must be a whole number of at least 0, got -1"),
        (["--eval-episodes", "0"], "eval_episodes must be a whole number of at least 1, got 0"),
        (["--stop-at", "1.5"], "stop_at must be a finite number above 0 and of at most 1"),
        (["--seed", "-1"], "seed must be a whole number of at least 0, got -1"),
        (["--max-steps", "3000000000"], "max_steps must be a whole number of at least 1 and at mo"),
        (["--epsilon-steps", "3000000000"], "at most 2147483647, got 3000000000"),
        (["--learning-starts", "200000000000"], "at most 2147483647, got 200000000000"),
        (["--learning-starts", "-1"], "learning_starts must be a whole number of at least 0, got"),
        (["--gamma", "0"], "gamma must be a finite number above 0 and of at most 1, got 0.0"),
        (["--gamma", "nan"], "gamma must be a finite number above 0 and of at most 1, got nan"),
        (["--learning-rate", "inf"], "learning_rate must be a finite number above 0, got inf"),
        (["--seed", "2147483647", "--num-seeds", "2"], "seed must be at most 2147483646, got 2147"),
        (["--total-steps", "3000000000"], "total_steps must be a whole number from 1 to 20000000"),
        (["--strides", "0", "1", "1"], "strides must be a tuple of three values, each a whole nu"),
        (["--widths", "16", "0", "32"], "widths must be a tuple of three values, each a whole nu"),
        (["--size", "4", "4"], "leave nothing of (4, 4)"),
        (["--network", "nowhere:Net"], "network: module 'nowhere' cannot be imported"),
        (["--reward", "nowhere:f"], "reward: module 'nowhere' cannot be imported"),
        (["--config", "nowhere.json"], "nowhere.json cannot be read"),
        (["--init-from", "nowhere"], "nowhere is not a run folder and not an agent"),
    ],
)
def test_bad_input_gets_one_sentence_and_status_2(arguments, message, capsys, tmp_path):
    folder = tmp_path / "run"
    preset = [] if "--preset" in arguments or "--config" in arguments else ["--preset", "pixels"]
    assert main(["train", "--out", str(folder), *preset, *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not folder.exists()


@pytest.mark.parametrize("preset", list(PRESETS))
def test_help_shows_the_values_of_the_preset(preset, capsys):
    with pytest.raises(SystemExit) as exit_info:
        main(["train", "--preset", preset, "--help"])
    assert exit_info.value.code == 0
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    for name in flat_names(PRESETS[preset]):
        assert f"--{name.replace('_', '-')}" in text
    assert f"(default: {PRESETS[preset].total_steps})" in text


def test_warp_without_its_extra_is_rejected(capsys, tmp_path):
    if "warp" in sys.modules or __import__("importlib.util").util.find_spec("warp"):
        pytest.skip("the extra `warp` is installed")
    assert main(["train", "--physics", "mjx-warp", "--out", str(tmp_path / "run")]) == 2
    assert "extra 'warp'" in capsys.readouterr().err


def test_an_output_folder_that_cannot_be_one_is_rejected(capsys, tmp_path):
    file = tmp_path / "file"
    file.write_text("")
    full = tmp_path / "full"
    full.mkdir()
    (full / "thesis.tex").write_text("")
    # Where nobody can make a folder, not even root.
    nowhere = pathlib.Path("/proc/self/mjx_arm")
    rejected = [(file, "is a file"), (full, "is not empty"), (nowhere, "cannot be made")]
    for folder, message in rejected[: 3 if sys.platform == "linux" else 2]:
        assert main(["train", *TINY, "--out", str(folder)]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
    assert [path.name for path in full.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize("present", [False, True])
def test_an_unused_nvidia_card_is_pointed_out(present, monkeypatch, capsys, tmp_path):
    from rich.console import Console

    from mjx_arm.report import progress

    if jax.default_backend() != "cpu":
        pytest.skip("jax already uses an accelerator")
    if present:
        card = tmp_path / "nvidia-smi"
        card.write_text("#!/bin/sh\n")
        card.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    progress.say_device(Console(width=200))
    assert ("make setup GPU=cuda13" in capsys.readouterr().out) == present


def test_eval_prints_json(run_folder, capsys):
    assert main(["eval", str(run_folder), "--episodes", "5", "--env", "B", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["episodes"] == 5
    assert set(report) == {
        *("episodes", "successes", "rate", "ci95", "mean_length", "metrics", "differs"),
    }
    assert report["differs"]["env"] == ["A", "B"]


def test_play_writes_a_gif(run_folder, tmp_path, capsys):
    path = tmp_path / "policy.gif"
    assert main(["play", str(run_folder), "--out", str(path), "--max-steps", "25"]) == 0
    assert imageio.imread(path, index=0).shape == (384, 768, 3)
    said = capsys.readouterr().out.splitlines()
    # On a slow machine lines say how long it takes.
    assert [line for line in said if "so far" not in line] == [
        "an episode in A: compiling comes first",
        "rendering the video",
        f"{path}: 26 frames, success: False",
    ]


@pytest.mark.parametrize(
    ("name", "message"),
    [("video.avi", "ends in '.avi'"), ("nowhere/video.mp4", "a folder that exists")],
)
def test_a_video_that_could_not_be_written_is_rejected_first(
    name, message, run_folder, tmp_path, capsys
):
    assert main(["play", str(run_folder), "--out", str(tmp_path / name)]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_figures_of_a_run_without_metrics_are_rejected(tmp_path, capsys):
    save_run(tmp_path, SavedRun(TrainConfig(), {}, load_scene("arm_cube").source))
    # A process that was killed has left half a line.
    (tmp_path / "metrics.jsonl").write_text('{"env_steps": 20')
    assert main(["figures", str(tmp_path)]) == 2
    assert "holds no metrics yet" in capsys.readouterr().err


def test_figures_draws_the_curves_again(run_folder, capsys):
    (run_folder / "learning.png").unlink()
    assert main(["figures", str(run_folder)]) == 0
    assert (run_folder / "learning.png").is_file()
    assert "learning.png" in capsys.readouterr().out


@pytest.mark.parametrize("command", ["eval", "play"])
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--epsilon", "10"], "epsilon must be a finite number from 0 to 1, got 10.0"),
        (["--epsilon", "nan"], "epsilon must be a finite number, got nan"),
        (
            ["--seed", "100000000000000000000"],
            "seed must be from 0 to 2147483647, got 100000000000000000000",
        ),
        (
            ["--max-steps", "10000000000"],
            "max_steps must be a whole number of at least 1 and at most 2147483647, got",
        ),
    ],
)
def test_bad_options_of_a_try_are_rejected(
    command, arguments, message, run_folder, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert main([command, str(run_folder), *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["eval", "play", "figures"])
def test_what_is_not_a_run_is_rejected(command, tmp_path, capsys):
    assert main([command, str(tmp_path / "nothing")]) == 2
    error = capsys.readouterr().err
    assert "is not a run folder" in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("command", ["eval", "play"])
@pytest.mark.parametrize("damage", ["short", "foreign", "flipped", "edited", "other network"])
def test_a_file_that_is_not_an_agent_is_rejected(command, damage, run_folder, tmp_path, capsys):
    path = tmp_path / "some.safetensors"
    content = (run_folder / "best.safetensors").read_bytes()
    if damage == "short":
        path.write_bytes(content[:-1000])
    elif damage == "foreign":
        path.write_bytes(b"PK\x03\x04 nothing of ours")
    elif damage == "flipped":
        path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    elif damage == "edited":
        path.write_bytes(content.replace(b'gamma\\": 0.99', b'gamma\\": 0.98'))
    else:
        # Metadata and digest are right, but the tensors are those of another network.
        metadata, tensors = read_agent(run_folder / "best.safetensors")
        config = parse_config(metadata["config"], "test")
        save_agent(
            path,
            set_train_options(config, {"hidden": 32}),
            flax.traverse_util.unflatten_dict(tensors, sep="/"),
            scene=SceneSource.from_json(json.loads(metadata["scene"]), "test"),
            objects={},
            env_steps=0,
        )
    assert main([command, str(path)]) == 2
    error = capsys.readouterr().err
    assert str(path) in error
    assert error.count("\n") == 1


def test_the_best_agent_is_the_one_that_selection_found(run_folder):
    best, last = load_agent(run_folder), load_agent(run_folder / "last.safetensors")
    rates = {row["env_steps"]: row["selection_rate"] for row in read_metrics(run_folder)}
    assert rates == {200: 0.0, 400: 0.0}
    assert (best.selection_rate, best.env_steps) == (0.0, 400)
    assert (last.selection_rate, last.env_steps) == (None, 400)


@pytest.mark.slow
def test_seeds_have_folders_of_their_own(tmp_path, capsys):
    folder = tmp_path / "run"
    options = [*TINY, "--num-seeds", "2", "--seed", "3"]
    assert main(["train", *options, "--out", str(folder)]) == 0
    for seed in (3, 4):
        own = folder / f"seed-{seed}"
        assert load_config(own).seed == seed
        assert len(read_metrics(own)) == 2
        assert load_agent(own).env_steps == 400
        assert 100 < len(read_video(own / "policy.mp4")) <= 1001
    assert np.asarray(imageio.imread(folder / "figure3.png")).std() > 5
    assert main(["eval", str(folder), "--episodes", "2"]) == 2
    assert "seed-3" in capsys.readouterr().err


def test_a_file_of_options_is_a_starting_point(run_folder, tmp_path):
    """Any run's `config.json`, and what is said on the command line beside it."""
    folder = tmp_path / "run"
    arguments = ["--config", str(run_folder / "config.json"), "--seed", "9", "--eval-episodes", "2"]
    arguments += ["--total-steps", "200", "--no-video"]
    assert main(["train", *arguments, "--out", str(folder)]) == 0
    expected = set_train_options(load_config(run_folder), {"seed": 9, "total_steps": 200})
    assert load_config(folder) == expected


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "is not JSON: line 1"),
        ("[]", "must hold one JSON object"),
        ('{"env": "B", "lift": 0.3}', "was written by mjx_arm 0.1"),
        ('{"format": 3}', "has the format 3; this version reads 2"),
        (json.dumps(dump_config(train_config()) | {"num_env": 3}), "did you mean 'num_envs'?"),
        (json.dumps(dump_config(train_config()) | {"num_envs": 2.5}), "num_envs must be a whole"),
    ],
)
def test_a_file_of_options_that_does_not_fit_is_rejected(content, message, tmp_path, capsys):
    path = tmp_path / "config.json"
    path.write_text(content)
    assert main(["train", "--config", str(path), "--out", str(tmp_path / "run")]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert str(path) in error
    assert error.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_a_preset_and_a_file_exclude_each_other(run_folder, capsys):
    path = str(run_folder / "config.json")
    assert main(["train", "--config", path, "--preset", "fast"]) == 2
    assert "--preset and --config exclude each other" in capsys.readouterr().err
