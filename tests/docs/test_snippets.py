"""Every snippet of README and documentation runs, with few steps where it trains.

Commands of the shell are checked by default: their program, their options, the files that they
name. Those of `mjx-arm` also run: a cheap one of each kind as a slow test, the others as long ones.
"""

from __future__ import annotations

import itertools
import os
import pathlib
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
import types

import pytest
from doc_pages import ROOT, Snippet, all_snippets, commands, split_environment

import mjx_arm
from mjx_arm.cli import main
from mjx_arm.cli.parse import parse
from mjx_arm.deploy.dynamixel import read_config
from mjx_arm.presets import PRESETS
from mjx_arm.training.agent import find_agent

# What a training is shortened to. The last one of an option counts.
_SHORT = {
    "total-steps": 1024,
    "chunk-steps": 512,
    "num-envs": 8,
    "replay-size": 2048,
    "learning-starts": 64,
    "select-every": 0,
    "eval-episodes": 2,
    "max-steps": 20,
}
_SHORT_BATCH = {
    "dqn": {"batch-size": 16},
    "distill": {
        "teacher-batch-size": 16,
        "teacher-hidden": 16,
        "student-batch-size": 16,
        "student-starts": 256,
    },
}
_SHORT_TRIES = {"eval": {"episodes": 2, "max-steps": 20}, "play": {"max-steps": 20}}
# These wait for a browser, train many runs or need several; they have tests of their own.
# The true levels of the stand-in are read three times an agent, and never by a test.
_OWN_TESTS = {"compare", "deploy", "sweep", "transfer", "view"}
_SHELL = all_snippets("sh")
# The first one of each of these commands on the pages is a slow test.
_CHEAP = ("agents", "eval", "export", "play")
# Scripts for Slurm, and what their variables are in the tests.
_SBATCH = sorted((ROOT / "docs").rglob("*.sbatch"))
_VARIABLES = {"$run": "runs/first", "$RUN": "runs/first"}
# Marks of Python that this process cannot run.
_ELSEWHERE = ("check", "devices")


def _name(snippet: Snippet) -> str:
    return f"{snippet.page}:{snippet.line}"


def _marked(language: str, mark: str) -> list[Snippet]:
    return [each for each in all_snippets(language) if each.mark == mark]


@pytest.fixture
def folder(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> pathlib.Path:
    """A folder like a clone of the repository, with runs in it; the working directory."""
    for name in ("examples", "docs", "benchmarks", "requirements", "Makefile", "train.py"):
        (tmp_path / name).symlink_to(ROOT / name)
    for run in ("runs/NAME", "runs/three/seed-1"):
        (tmp_path / run).mkdir(parents=True)
        shutil.copy(find_agent(pathlib.Path("agent-b")), tmp_path / run / "best.safetensors")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return tmp_path


def _python_pages() -> list[object]:
    """The snippets of each page with the same mark, which share their names."""
    found = []
    key = lambda each: (each.page, each.mark)  # noqa: E731
    for (page, mark), group in itertools.groupby(sorted(all_snippets("python"), key=key), key):
        if mark in _ELSEWHERE:
            continue
        # The README has no room for a comment, and its snippet compiles for half a minute.
        mark = "slow" if page == "README.md" else mark
        marks = [getattr(pytest.mark, mark)] if mark else []
        found.append(pytest.param(list(group), id=page, marks=marks))
    return found


@pytest.mark.parametrize("group", _python_pages())
def test_python_snippets_run(
    group: list[Snippet], folder: pathlib.Path, monkeypatch: pytest.MonkeyPatch
):
    module = types.ModuleType("snippet")
    monkeypatch.setitem(sys.modules, "snippet", module)
    for each in group:
        # As many lines before it as in the page, for the traceback.
        code = "\n" * (each.line - 1) + each.text
        path = str(ROOT / each.page)
        exec(compile(code, path, "exec", dont_inherit=True), module.__dict__)


@pytest.mark.parametrize("snippet", _marked("python", "check"), ids=_name)
def test_python_snippets_for_other_machines_compile(snippet: Snippet):
    compile(snippet.text, snippet.page, "exec", dont_inherit=True)


@pytest.mark.slow
def test_python_snippets_for_several_devices_run():
    """With four devices and a short training as `config`."""
    values = _SHORT | _SHORT_BATCH["dqn"] | {"observation": "state"}
    del values["eval-episodes"]
    options = {name.replace("-", "_"): value for name, value in values.items()}
    group = _marked("python", "devices")
    assert {each.page for each in group} == {"docs/scaling.md"}
    code = f"import mjx_arm\n\nconfig = mjx_arm.train_config(**{options!r})\n"
    code += "".join(each.text for each in group)
    code += "print(mesh.size, states.envs.ended.shape, counts['steps'].shape)\n"
    flags = "--xla_force_host_platform_device_count=4"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        env=os.environ | {"XLA_FLAGS": flags, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    # Eight seeds of eight environments, two chunks.
    assert done.stdout == "4 (8, 8) (8, 2)\n"


@pytest.mark.parametrize("snippet", _SHELL, ids=_name)
def test_shell_snippets_name_what_there_is(snippet: Snippet, folder: pathlib.Path):
    subprocess.run(["bash", "-n", "-c", snippet.text], check=True)
    for words in commands(snippet.text):
        environment, words = split_environment(words)
        sys.path.extend(environment.get("PYTHONPATH", "").split(":"))
        program = pathlib.Path(words[0]).name
        assert program in _CHECKS, f"no check for {program}"
        _CHECKS[program](words[1:])


def _check_mjx_arm(words: list[str]) -> None:
    if "--help" not in words:
        parse(words)


def _check_make(words: list[str]) -> None:
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("MAKE", "MFLAGS"))}
    subprocess.run(["make", "--dry-run", *words], check=True, capture_output=True, env=environment)


def _check_python(words: list[str]) -> None:
    script = pathlib.Path(words[0])
    assert script.is_file(), script
    text = script.read_text()
    if "parse_known_args" not in text:
        for option in (word for word in words if word.startswith("--")):
            assert f'"{option}"' in text, f"{script} has no {option}"


def _check_pip(words: list[str]) -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    assert words[:2] == ["install", "--editable"]
    assert re.fullmatch(r"\.\[(\w+)\]", words[2])[1] in extras


def _check_sbatch(words: list[str]) -> None:
    assert pathlib.Path(words[0]).is_file()
    parse(["train", *(word.replace("$seed", "0") for word in words[1:])])


def _check_taskset(words: list[str]) -> None:
    assert words[0] == "-c"
    _CHECKS[pathlib.Path(words[2]).name](words[3:])


def _check_source(words: list[str]) -> None:
    assert words == [".venv/bin/activate"]


_CHECKS = {
    "make": _check_make,
    "mjx-arm": _check_mjx_arm,
    "pip": _check_pip,
    "python": _check_python,
    "sbatch": _check_sbatch,
    "source": _check_source,
    "taskset": _check_taskset,
}


def _runs() -> list[object]:
    """The different commands `mjx-arm` of all pages that can run on this machine."""
    found = {}
    for snippet in _SHELL:
        for words in commands(snippet.text):
            environment, words = split_environment(words)
            program = pathlib.Path(words[0]).name
            if program != "mjx-arm" or snippet.mark == "check" or "--help" in words:
                continue
            if words[1:2] and words[1] in _OWN_TESTS:
                continue
            found.setdefault(tuple(words[1:]), (environment.get("PYTHONPATH", ""), _name(snippet)))
    cheap = {next(x for x in found if x[0] == command) for command in _CHEAP}
    assert cheap <= set(found)
    return [
        pytest.param(
            list(x), path, id=name, marks=pytest.mark.slow if x in cheap else pytest.mark.long
        )
        for x, (path, name) in found.items()
    ]


def _options(values: dict[str, int]) -> list[str]:
    return [word for name, value in values.items() for word in (f"--{name}", str(value))]


def _shortened(words: list[str]) -> list[str]:
    if words[0] == "train":
        algorithm = parse(words)[0].options.algorithm
        return [*words, *_options(_SHORT | _SHORT_BATCH[algorithm])]
    return [*words, *_options(_SHORT_TRIES.get(words[0], {}))]


@pytest.mark.parametrize(("words", "path"), _runs())
def test_commands_of_the_pages_run(words: list[str], path: str, folder: pathlib.Path):
    sys.path.extend(path.split(":"))
    more = []
    if "--resume" in words or words[0] == "figures":
        shutil.rmtree(folder / "runs" / "NAME")
        start = ["train", "--preset", "state", "--out", "runs/NAME"]
        assert main(_shortened(start)) == 0
        more = ["--eval-episodes", "2"] if "--resume" in words else []
        if "--total-steps" in words:
            words = words[: words.index("--total-steps")]
            more += ["--total-steps", "1536"]
    arguments = [*words, *more] if more or words[0] == "figures" else _shortened(words)
    assert main(arguments) == 0


@pytest.mark.parametrize("script", _SBATCH, ids=lambda path: path.stem)
def test_job_scripts_name_options_that_there_are(script: pathlib.Path, folder: pathlib.Path):
    subprocess.run(["bash", "-n", script], check=True)
    text = script.read_text()
    asked = [line for line in text.splitlines() if line.startswith("#SBATCH")]
    assert asked
    assert all(re.fullmatch(r"#SBATCH --[a-z-]+(=\S+)?", line) for line in asked)
    lines = re.findall(r"^ *(?:exec|srun) (.*)$", text.replace("\\\n", " "), re.MULTILINE)
    # One that starts a run, and one that continues it.
    assert len(lines) == 2
    for line in lines:
        words = shlex.split(line.replace('"$@"', ""))
        assert words[0] == ".venv/bin/mjx-arm"
        command, given = parse([_VARIABLES.get(word, word) for word in words[1:]])
        if "preset" in given:
            # Larger in proportion: the same work for each environment.
            preset = PRESETS[command.preset]
            assert command.options.samples_per_step == preset.samples_per_step
            factor = command.options.num_envs // preset.num_envs
            assert command.options.replay.replay_size == factor * preset.replay.replay_size


@pytest.mark.slow
def test_the_job_script_starts_a_run_and_continues_it(tmp_path: pathlib.Path):
    """The script of the page about Slurm, by bash."""
    script = ROOT / "docs" / "how-to" / "train.sbatch"
    program = tmp_path / ".venv" / "bin" / "mjx-arm"
    program.parent.mkdir(parents=True)
    program.symlink_to(pathlib.Path(sys.executable).with_name("mjx-arm"))
    environment = os.environ | {"RUN": "runs/first"}
    options = _options(_SHORT | _SHORT_BATCH["dqn"])
    command = ["bash", str(script), "--preset", "state", *options]
    for expected in ("training:", "resuming after"):
        done = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        assert expected in done.stdout
    assert mjx_arm.load_agent(tmp_path / "runs" / "first").env_steps == 1024


def test_the_file_of_an_arm_can_be_read(tmp_path):
    (snippet,) = all_snippets("json")
    path = tmp_path / "arm.json"
    path.write_text(snippet.text)
    config = read_config(path)
    assert (config.gripper_open, config.gripper_closed) == (2900, 1600)
