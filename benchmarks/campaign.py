"""Tries to break training runs and their files, and counts what broke.

    python benchmarks/campaign.py
    python benchmarks/campaign.py --parts kills locks
    python benchmarks/campaign.py --table benchmarks/results/campaign.md

It prints one table at the end, which `--table` also writes, beside the rows of earlier calls. Each
part can run alone (`--parts`), and one that crashes leaves the others their rows. All together take
under two hours on two cores; `tests/benchmarks/test_campaign.py` tries each at a small scale.

- `kills`: runs are killed at random moments, with one seed and with two. Each must continue to the
  same bits as a run that was never killed.
- `disks`: file systems in memory of four sizes fill up. Each run must end in one sentence, and
  continue to the same bits once there is room. Mounting needs root on Linux.
- `flips`: single bits flip in agents, checkpoints and configurations (all must be found), in
  metrics (a line that is not JSON must be named), in pictures and event files (no traceback).
- `swaps`: a checkpoint is replaced by one of another step, run or seed, and a number of the
  configuration by another. All must be found.
- `options`: generated configurations, valid and invalid, from the library and the command line.
  Each must be accepted and come back from JSON as it was, or be rejected in one sentence.
- `nans`: the controls of 1 % of the steps are NaN, for both storages of the replay. Those steps
  must be counted as diverged, and all parameters stay finite.
- `locks`: two processes start in one folder at once. One must train, the other must be rejected.
- `memory`: ten minutes of training must not need more and more memory.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import io
import json
import math
import os
import pathlib
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy
from machine import machine
from rich.console import Console

import mjx_arm
from mjx_arm.cli import main as mjx_arm_main
from mjx_arm.config import TrainConfig, dump_config, parse_config, set_train_options, train_config
from mjx_arm.options import flat_names
from mjx_arm.report.metrics import read_metrics

# A run of seconds that has every phase: compiling, training, selecting, evaluating and a video.
TINY = [
    *("--preset", "pixels", "--physics", "native", "--num-envs", "4", "--size", "16", "16"),
    *("--replay-size", "400", "--batch-size", "8", "--learning-starts", "40"),
    *("--chunk-steps", "200", "--max-steps", "25", "--hidden", "16", "--eval-episodes", "4"),
    *("--select-every", "2000", "--select-episodes", "2", "--total-steps", "8000"),
]
# Without images it compiles in a fraction of the time.
STATE = [*TINY, "--observation", "state", "--total-steps", "4000"]
AGENT_FILES = ("last.safetensors", "best.safetensors")


@dataclasses.dataclass
class Row:
    """One line of the table: what was tried, how often, what must happen, and what broke.

    Attributes:
      part: of the campaign.
      tried: what was done.
      wanted: what must happen each time.
      attempts: how often it was tried.
      failures: a sentence for each time that something else happened.
      note: of interest beside the counts.
    """

    part: str
    tried: str
    wanted: str
    attempts: int = 0
    failures: list[str] = dataclasses.field(default_factory=list)
    note: str = ""

    def expect(self, good: bool, otherwise: str) -> None:
        """Counts one attempt."""
        self.attempts += 1
        if not good:
            self.failures.append(" ".join(otherwise.split())[:300])


def command(*arguments: str | pathlib.Path) -> list[str]:
    """The command line of a training in a process of its own."""
    return [sys.executable, "-m", "mjx_arm", "train", *map(str, arguments)]


def in_process(*arguments: str | pathlib.Path) -> tuple[int, str, str]:
    """Exit status, standard output and standard error of the command line in this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = mjx_arm_main([str(x) for x in arguments])
        except SystemExit as stop:
            status = int(stop.code or 0)
        except Exception as error:  # a traceback is what the campaign looks for
            return -1, out.getvalue(), f"Traceback: {type(error).__name__}: {error}"
    return status, out.getvalue(), err.getvalue()


def is_sentence(status: int, error: str) -> bool:
    """Whether a rejection is one line, with exit status 2."""
    return status == 2 and error.startswith("error: ") and error.count("\n") == 1


def fingerprint(folder: pathlib.Path) -> str:
    """All that a finished run leaves and that does not depend on the time: metrics and agents."""
    found: list[Any] = []
    folders = [folder, *sorted(folder.glob("seed-*"))]
    for one in folders:
        if (one / "metrics.jsonl").is_file():
            rows = [{**row, "steps_per_s": 0, "wall_s": 0} for row in read_metrics(one)]
            found.append(repr(rows))
        for name in AGENT_FILES:
            if (one / name).is_file():
                tensors = safetensors.numpy.load_file(one / name)
                found.append({key: x.tobytes().hex() for key, x in sorted(tensors.items())})
        if (one / "evaluation.json").is_file():
            evaluation = json.loads((one / "evaluation.json").read_text())
            found.append((evaluation["episodes"], evaluation["successes"]))
    assert found, f"{folder} holds no run"
    return repr(found)


def run_to_end(folder: pathlib.Path, options: list[str]) -> None:
    """A run that nothing disturbs."""
    subprocess.run(command(*options, "--out", folder), check=True, capture_output=True)


def kills(folder: pathlib.Path, scale: float) -> Iterator[Row]:
    """Kills runs at random moments; two of three have one seed."""
    moments = random.Random(0)
    for seeds, count in ((1, 24), (2, 12)):
        options = [*TINY, "--num-seeds", str(seeds)]
        whole = folder / f"whole-{seeds}"
        run_to_end(whole, options)  # compiles
        shutil.rmtree(whole)
        started = time.monotonic()
        run_to_end(whole, options)
        length = time.monotonic() - started
        what = f"SIGKILL at a random moment, {seeds} seed{'s' if seeds > 1 else ''}"
        row = kill_runs(what, whole, options, moments, length, max(1, round(count * scale)))
        row.note += f" of {length:.0f} s"
        yield row


def kill_runs(
    what: str,
    whole: pathlib.Path,
    options: list[str],
    moments: random.Random,
    length: float,
    count: int,
) -> Row:
    """Kills runs a number of times, and compares their ends.

    Args:
      what: the row says of it.
      whole: a run with the same options that was never killed. The others get folders beside it.
      options: of the runs.
      moments: chooses the moments.
      length: seconds before which they are.
      count: number of kills.
    """
    row = Row("kills", what, "continues to the bits of a run that was never killed")
    wanted, runs = fingerprint(whole), 0
    while row.attempts < count:
        own = whole.with_name(f"{whole.name}-killed-{runs}")
        died, error = _run_with_kills(own, options, moments, length, count - row.attempts)
        same = not error and fingerprint(own) == wanted
        # Every kill of a run whose end is right was survived. A run that none has met is repeated.
        for _ in range(died if same else max(died, 1)):
            row.expect(same, error or f"run {runs} ends in other bits")
        runs += 1
        shutil.rmtree(own)
    row.note = f"{runs} run{'s' if runs > 1 else ''}"
    return row


def _run_with_kills(
    folder: pathlib.Path, options: list[str], moments: random.Random, length: float, most: int
) -> tuple[int, str]:
    """Runs to the end through kills; their number, and an error where it did not get there."""
    died = 0
    while True:
        begun = (folder / "config.json").is_file()
        again = command("--resume", folder, "--eval-episodes", "4")
        started = again if begun else command(*options, "--out", folder)
        pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
        process = subprocess.Popen(started, text=True, **pipes)  # type: ignore[call-overload]
        limit = moments.uniform(0.05, 1.0) * length if died < most else 20 * length
        try:
            error = process.communicate(timeout=limit)[1]
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.communicate()
            died += 1
            continue
        return died, "" if process.returncode == 0 else f"exit {process.returncode}: {error}"


def disks(folder: pathlib.Path, scale: float) -> Iterator[Row]:
    """Fills file systems of four sizes, which then get room."""
    row = Row(
        "disks",
        "file systems that fill up at 10, 30, 60 and 90 % of a run",
        "ends in one sentence, then continues to the same bits in a larger one",
    )
    options = [*TINY, "--storage", "pixels", "--replay-size", "8000"]
    whole = folder / "whole"
    run_to_end(whole, options)
    wanted = fingerprint(whole)
    size = sum(path.stat().st_size for path in whole.rglob("*") if path.is_file())
    for share in (0.1, 0.3, 0.6, 0.9)[: max(1, round(4 * scale))]:
        mount = folder / f"disk-{share}"
        mount.mkdir()
        kilobytes = max(64, int(share * size / 1024))
        if not _mount(mount, kilobytes, "size"):
            row.note = "not run: mounting a tmpfs needs root on Linux"
            break
        try:
            done = _run(command(*options, "--out", mount / "run"))
            lines = done.stderr.count("\n")
            said = done.returncode == 2 and lines == 1 and "Traceback" not in done.stderr
            if not said:
                row.expect(False, f"{share}: exit {done.returncode}, {lines} lines: {done.stderr}")
                continue
            _mount(mount, 4 * size // 1024, "remount,size")
            begun = (mount / "run/config.json").is_file()
            if not begun:
                shutil.rmtree(mount / "run", ignore_errors=True)
            again = ("--resume", mount / "run", "--eval-episodes", "4")
            done = _run(command(*again) if begun else command(*options, "--out", mount / "run"))
            good = done.returncode == 0 and fingerprint(mount / "run") == wanted
            row.expect(good, f"{share}: continued with exit {done.returncode}: {done.stderr}")
        finally:
            subprocess.run(["umount", mount], check=False, capture_output=True)
    yield row


def _mount(folder: pathlib.Path, kilobytes: int, option: str) -> bool:
    options = f"{option}={kilobytes}k"
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder], check=False, capture_output=True
    )
    return done.returncode == 0


def _run(arguments: list[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(arguments, check=False, capture_output=True, text=True)


def flips(folder: pathlib.Path, scale: float) -> Iterator[Row]:
    """Flips single bits in every kind of file of a run."""
    whole, rng = folder / "run", random.Random(0)
    run_to_end(whole, STATE)
    more = ("--total-steps", "4200", "--eval-episodes", "4")

    def row(what: str, wanted: str) -> Row:
        return Row("flips", f"one bit of {what}", wanted)

    rejected, agent, config = (
        "rejected in one sentence",
        whole / AGENT_FILES[0],
        whole / "config.json",
    )
    agents, checkpoints = row("an agent", rejected), row("the newest checkpoint", rejected)
    configs = row("config.json", rejected)
    _flip_each(agents, agent, _places(agent, rng, round(200 * scale)), "eval", agent)
    yield agents
    newest = sorted((whole / "checkpoints").iterdir())[-1]
    files = [path for path in newest.rglob("*") if path.is_file() and path.stat().st_size]
    for path in rng.choices(files, k=max(1, round(100 * scale))):
        _flip_each(checkpoints, path, _places(path, rng, 1), "train", "--resume", whole, *more)
    yield checkpoints
    places = _places(config, rng, round(100 * scale))
    _flip_each(configs, config, places, "train", "--resume", whole, *more)
    yield configs

    metrics = row("metrics.jsonl", "a damaged line is named; a changed digit is out of scope")
    path = whole / "metrics.jsonl"
    while metrics.attempts < max(1, round(50 * scale)):
        (place,) = _places(path, rng, 1)
        with _flipped(path, place):
            if _is_metrics(path):
                continue
            status, _, error = in_process("train", "--resume", whole, *more)
            named = is_sentence(status, error) and "metrics.jsonl" in error
            metrics.expect(named, f"bit {place}: exit {status}, {error}")
    yield metrics

    pictures = row("a picture, a video or an event file", "no traceback")
    kinds = (*whole.glob("*.png"), *whole.glob("*.mp4"), *(whole / "tensorboard").iterdir())
    for i in range(max(1, round(6 * scale))):
        own = folder / f"pictures-{i}"
        shutil.copytree(whole, own)
        for kind in kinds:
            path = own / kind.relative_to(whole)
            for place in _places(path, rng, 8):
                path.write_bytes(_flip(path.read_bytes(), place))
        status, _, error = in_process("train", "--resume", own, *more)
        pictures.expect(status == 0, f"exit {status}, {error}")
        shutil.rmtree(own)
    yield pictures


def _flip_each(
    row: Row, path: pathlib.Path, places: list[int], *command: str | pathlib.Path
) -> None:
    """Flips each bit of a file alone; the command must reject the file each time."""
    for place in places:
        with _flipped(path, place):
            status, _, error = in_process(*command)
            row.expect(
                is_sentence(status, error), f"{path.name}, bit {place}: exit {status}, {error}"
            )


def _places(path: pathlib.Path, rng: random.Random, count: int) -> list[int]:
    """Bits to flip, half of them in the first 2 kB, where the structure is."""
    bits = 8 * path.stat().st_size
    return [rng.randrange(min(bits, 16_384) if i % 2 else bits) for i in range(max(1, count))]


def _flip(content: bytes, place: int) -> bytes:
    changed = bytearray(content)
    changed[place // 8] ^= 1 << place % 8
    return bytes(changed)


@contextlib.contextmanager
def _flipped(path: pathlib.Path, place: int) -> Iterator[None]:
    content = path.read_bytes()
    path.write_bytes(_flip(content, place))
    try:
        yield
    finally:
        path.write_bytes(content)


def _is_metrics(path: pathlib.Path) -> bool:
    """Whether each line is still an object with the same names."""
    try:
        rows = [json.loads(line) for line in path.read_text().splitlines()]
        return all(isinstance(row, dict) and row.keys() == rows[0].keys() for row in rows)
    except (ValueError, UnicodeDecodeError):
        return False


def swaps(folder: pathlib.Path, scale: float) -> Iterator[Row]:
    """Puts checkpoints in the place of others, and other numbers into the configuration."""
    one, other = folder / "one", folder / "other"
    run_to_end(one, STATE)
    run_to_end(other, [*STATE, "--seed", "1"])
    more = ("--total-steps", "4200", "--eval-episodes", "4")
    row = Row("swaps", "a checkpoint of another step or run", "rejected in one sentence")
    steps = sorted((one / "checkpoints").iterdir())
    for source in (steps[0], *sorted((other / "checkpoints").iterdir())):
        own = folder / "swapped"
        shutil.copytree(one, own)
        target = own / "checkpoints" / steps[-1].name
        shutil.rmtree(target)
        shutil.copytree(source, target)
        status, _, error = in_process("train", "--resume", own, *more)
        row.expect(is_sentence(status, error), f"{source}: exit {status}, {error}")
        shutil.rmtree(own)
    yield row

    row = Row("swaps", "a number in config.json", "rejected in one sentence")
    path = one / "config.json"
    text = path.read_text()
    for keys, value in _numbers(json.loads(text)):
        if row.attempts >= max(2, round(60 * scale)):
            break
        changed = json.loads(text)
        place = changed
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = value * 2 if value else 1
        path.write_text(json.dumps(changed))
        status, _, error = in_process("train", "--resume", one, *more)
        named = ".".join(map(str, keys))
        row.expect(is_sentence(status, error), f"{named}: exit {status}, {error}")
    path.write_text(text)
    yield row


def _numbers(tree: Any, keys: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], float]]:
    """The numbers of a JSON object and where they are."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree)
    for key, value in items:
        if isinstance(value, dict | list):
            yield from _numbers(value, (*keys, key))
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield (*keys, key), value


# Values that come up by mistake, as they would be given in Python and on a command line.
_ODD: list[Any] = [
    *(0, -1, 1, 2, 7, 2.5, 1e30, -1e-9, 10**12, math.inf, -math.inf, math.nan),
    *(True, False, None, "", "many", "rgb", "1", b"1", (), (64,), (64, 64), (64, 64, 64), (0, 0)),
    *([64, 64], {"a": 1}, np.float32(0.5), np.int64(3), np.array([1, 2]), 3 + 1j, object()),
]


def options(folder: pathlib.Path, scale: float) -> Iterator[Row]:
    """Generates configurations from the library and from the command line."""
    rng = random.Random(0)
    names = sorted(flat_names(TrainConfig()))
    row = Row(
        "options",
        "a generated configuration, from the library",
        "comes back from JSON as it was, or is rejected in one sentence that names an option",
    )
    accepted = 0
    for _ in range(max(1, round(300 * scale))):
        base = rng.choice(list(mjx_arm.PRESETS.values()))
        chosen = {name: rng.choice(_ODD) for name in rng.sample(names, rng.randint(1, 3))}
        try:
            config = set_train_options(base, chosen)
        except ValueError as error:
            text = str(error)
            known = any(name in text for name in (*chosen, *names))
            row.expect("\n" not in text and known, f"{chosen}: {text!r}")
        except Exception as error:  # anything else would be a traceback
            row.expect(False, f"{chosen}: {type(error).__name__}: {error}")
        else:
            accepted += 1
            back = parse_config(json.dumps(dump_config(config)), "config.json")
            row.expect(back == config, f"{chosen}: comes back as another configuration")
    row.note = f"{accepted} were valid"
    yield row

    row = Row(
        "options",
        "a generated command line with an invalid value",
        "rejected in one sentence, exit status 2, nothing written",
    )
    texts = ["-1", "2.5", "nan", "inf", "1e400", "many", "", "0x10", "1,000", "--", "\udcff"]
    invalid = 0
    while invalid < max(1, round(60 * scale)):
        flag, text = rng.choice(names), rng.choice(texts)
        out = folder / f"out-{invalid}"
        arguments = [f"--{flag.replace('_', '-')}={text}", "--preset", "smoke"]
        if _is_valid(flag, text):
            continue
        invalid += 1
        done = _run(command(*arguments, "--out", out))
        said = is_sentence(done.returncode, done.stderr) and not out.exists()
        row.expect(said, f"{arguments}: exit {done.returncode}, {done.stderr}")
    yield row


def _is_valid(name: str, text: str) -> bool:
    """Whether an option might take a text; free texts do, and numbers those that they hold."""
    value = mjx_arm.PRESETS["smoke"]
    for convert in (int, float, str):
        try:
            converted = convert(text)
        except (ValueError, OverflowError):
            continue
        with contextlib.suppress(ValueError):
            set_train_options(value, {name: converted})
            return True
    return False


def nans(folder: pathlib.Path, scale: float, observation: str = "packed") -> Iterator[Row]:
    """Trains while the controls of 1 % of the steps are NaN, on images or on state features."""
    del folder
    for storage in ("states", "pixels"):
        row = Row(
            "nans",
            f"NaN controls in 1 % of the steps, replay of {storage}",
            "counted as diverged; loss and parameters stay finite",
        )
        config = train_config(
            storage=storage,
            observation=observation,
            physics="native",
            num_envs=8,
            size=(16, 16),
            replay_size=4_000,
        )
        config = set_train_options(
            config, {"batch_size": 8, "learning_starts": 200, "chunk_steps": 800, "hidden": 16}
        )
        env = mjx_arm.make("A", observation=observation, size=(16, 16), physics="native")
        trainer = mjx_arm.make_trainer(config, env=_with_nans(env))
        state = trainer.init(jax.random.key(0))
        steps, diverged = 0, 0.0
        for _ in range(max(1, round(20 * scale))):
            state, counts = trainer.run_chunk(state)
            steps, diverged = steps + 800, diverged + float(counts["diverged"])
            finite = all(np.isfinite(x).all() for x in jax.tree.leaves(state.learner.params))
            loss = float(counts["loss"])
            row.expect(finite and math.isfinite(loss), f"after {steps} steps: loss {loss}")
        share = diverged / steps
        row.expect(0.003 < share < 0.03, f"{share:.4f} of the steps counted as diverged")
        row.note = f"{diverged:.0f} of {steps} steps diverged"
        yield row


def _with_nans(env: Any) -> Any:
    """The environment with NaN controls in one of a hundred states, chosen by their bits."""
    physics = env.physics

    def step(state: Any, ctrl: jax.Array, params: Any = None) -> Any:
        bits = jax.lax.bitcast_convert_type(state.qpos, jnp.uint32)
        chosen = jnp.sum(bits * jnp.uint32(2_654_435_761)) >> 8
        broken = jnp.where(chosen % 100 == 0, jnp.nan, ctrl)
        return physics.step(state, broken, {} if params is None else params)

    return dataclasses.replace(env, physics=dataclasses.replace(physics, step=step))


def locks(folder: pathlib.Path, scale: float) -> Iterator[Row]:
    """Starts two processes in one folder at once."""
    row = Row(
        "locks", "two processes in one folder", "one trains to its end, the other is rejected"
    )
    for i in range(max(1, round(10 * scale))):
        own = folder / f"run-{i}"
        pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
        both = [
            subprocess.Popen(command(*STATE, "--out", own), text=True, **pipes)  # type: ignore[call-overload]
            for _ in range(2)
        ]
        try:
            errors = [process.communicate(timeout=600)[1] for process in both]
        except subprocess.TimeoutExpired:
            for process in both:
                process.kill()
            row.expect(False, "one did not end")
            continue
        ends = sorted(
            (process.returncode, error) for process, error in zip(both, errors, strict=True)
        )
        good = ends[0][0] == 0 and is_sentence(*ends[1])
        row.expect(good and fingerprint(own) != "", f"they ended with {ends}")
    yield row


def memory(folder: pathlib.Path, scale: float) -> Iterator[Row]:
    """Watches the memory of a training of ten minutes."""
    minutes = 10 * scale
    row = Row(
        "memory",
        f"a training of {minutes:g} minutes",
        "the second half needs at most 2 % more memory than the first at its most",
    )
    long = [*TINY, "--total-steps", "1000000000", "--select-every", "200000"]
    process = subprocess.Popen(
        command(*long, "--out", folder / "run"), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    seen: list[int] = []
    try:
        # Not while it starts and compiles.
        while process.poll() is None and not _has_saved(folder / "run"):
            time.sleep(0.1)
        end = time.monotonic() + 60 * minutes
        while time.monotonic() < end and process.poll() is None:
            time.sleep(min(5.0, 6 * minutes))
            seen.append(_resident(process.pid))
    finally:
        process.kill()
        _, error = process.communicate()
    first, second = seen[: len(seen) // 2], seen[len(seen) // 2 :]
    if not first:
        row.expect(False, f"it ended by itself: {error.decode(errors='replace')}")
    else:
        growth = max(second) / max(first) - 1
        row.expect(growth <= 0.02, f"{100 * growth:.1f} % more")
        row.note = f"{max(first) / 1e6:.0f} MB, then {max(second) / 1e6:.0f} MB"
    yield row


def _has_saved(run: pathlib.Path) -> bool:
    """Whether a run has a whole checkpoint."""
    return any((run / "checkpoints").glob("[0-9]*"))


def _resident(pid: int) -> int:
    """Bytes of a process in memory; Linux."""
    status = pathlib.Path(f"/proc/{pid}/statm").read_text()
    return int(status.split()[1]) * os.sysconf("SC_PAGE_SIZE")


PARTS: dict[str, Callable[[pathlib.Path, float], Iterator[Row]]] = {
    "kills": kills,
    "disks": disks,
    "flips": flips,
    "swaps": swaps,
    "options": options,
    "nans": nans,
    "locks": locks,
    "memory": memory,
}


@dataclasses.dataclass
class Result:
    """What a part came to.

    Attributes:
      rows: of the table.
      seconds: that it took.
    """

    rows: list[Row]
    seconds: float = 0.0

    def to_json(self) -> dict[str, Any]:
        """The result as a JSON object, with the machine."""
        rows = [dataclasses.asdict(row) for row in self.rows]
        return {"rows": rows, "seconds": round(self.seconds), "machine": machine()}


def run_part(name: str, scale: float = 1.0) -> Result:
    """Runs a part. One that crashes keeps its finished rows, and has one more about the crash.

    Args:
      name: of the part.
      scale: share of the attempts.
    """
    started, result = time.monotonic(), Result([])
    with tempfile.TemporaryDirectory() as folder:
        # The processes of a part share what one of them has compiled. The next part gets a new
        # folder: a process that is killed may leave half a program there.
        os.environ["JAX_COMPILATION_CACHE_DIR"] = f"{folder}/cache"
        try:
            result.rows.extend(PARTS[name](pathlib.Path(folder), scale))
        except Exception as error:
            traceback.print_exc()
            row = Row(name, "the part itself", "runs to its end")
            row.expect(False, f"{type(error).__name__}: {error}")
            result.rows.append(row)
    result.seconds = time.monotonic() - started
    return result


def table(parts: Mapping[str, Any]) -> str:
    """The results of parts, as JSON objects by their names, as a table in Markdown."""
    lines = [
        "| part | tried | must | attempts | failed | note |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for part in PARTS:
        for row in parts.get(part, {"rows": []})["rows"]:
            cells = [part, row["tried"], row["wanted"], row["attempts"], len(row["failures"])]
            lines.append("| " + " | ".join(map(str, [*cells, row["note"]])) + " |")
    lines += ["", "| part | seconds | machine |", "| --- | --- | --- |"]
    for part in PARTS:
        if part in parts:
            own = parts[part]["machine"]
            where = f"{own['cpu']}, {own['cores']} cores, Python {own['python']}, jax {own['jax']}"
            lines.append(f"| {part} | {parts[part]['seconds']} | {where} |")
    return "\n".join(lines)


def write_table(path: pathlib.Path, new: Mapping[str, Any]) -> None:
    """Writes results into a table, in the place of older ones of the same parts."""
    store = path.with_suffix(".json")
    parts = json.loads(store.read_text()) if store.is_file() else {}
    parts |= new
    store.write_text(json.dumps(parts, indent=1) + "\n")
    lines = [
        "# The campaign",
        "",
        "`python benchmarks/campaign.py --table FILE` wrote this page; see its docstring.",
        "",
        table(parts),
    ]
    path.write_text("\n".join(lines) + "\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the parts, prints their failures and a table, and returns 1 where something broke."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--scale", type=float, default=1.0, help="share of the attempts")
    parser.add_argument("--table", type=pathlib.Path, help="Markdown file, with JSON beside it")
    options = parser.parse_args(arguments)
    console, broken = Console(soft_wrap=True), False
    done: dict[str, Any] = {}
    try:
        for name in options.parts:
            result = run_part(name, options.scale)
            done[name] = result.to_json()
            for row in result.rows:
                broken = broken or bool(row.failures)
                failed = f"{len(row.failures)} of {row.attempts} failed"
                console.print(f"{name}: {row.tried}: {failed} {row.note}", markup=False)
                for failure in row.failures:
                    console.print(f"  {failure}", markup=False)
            if options.table:
                write_table(options.table, {name: done[name]})
    finally:
        # After Ctrl-C too.
        console.print(table(done), markup=False)
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
