"""What a GPU does, in one command of under 9 minutes; every result is written at once.

    python benchmarks/gpu.py --json DIR                     # the cells of one visit, in their order
    python benchmarks/gpu.py --json DIR --only b            # then environment B, 8 minutes
    python benchmarks/gpu.py --json DIR --only published    # then settings that others published
    python benchmarks/gpu.py --json DIR --ahead             # the same, compiled in parallel first
    JAX_PLATFORMS=cpu python benchmarks/gpu.py --store      # the CPU's values that parity needs

A cell is one figure. Cells with fewer figures come first, so that none is measured twice before
each is measured once; a repeated command appends. It needs neither a network nor orbax,
imageio-ffmpeg, tensorboardX, gymnasium and matplotlib; `wheels.py` fetches the rest. With `--ahead`
each cell has a process of its own: all compile in parallel, for it takes about a minute each, then
they measure one after another. `--tiny` rehearses it on a CPU.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import dataclasses
import functools
import importlib.util
import json
import os
import pathlib
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np
from machine import machine
from throughput import (
    compile_training,
    env_stages,
    peak_memory,
    time_chunks,
    time_training,
)

import mjx_arm
from mjx_arm.config import TrainConfig, set_train_options
from mjx_arm.physics import compiler_options
from mjx_arm.report.machine import versions
from mjx_arm.training.evaluate import make_evaluator
from mjx_arm.training.loop import SELECTION, make_trainer, role_key

ROOT = pathlib.Path(__file__).parents[1]
STORED = ROOT / "benchmarks" / "results" / "gpu-parity.json"
# Of the evaluations that say how far a training is; `train` selects by the same.
_SEED, _EPSILON = 2_000_003, 0.1
# Poses whose images are compared, and iterations of the motion that is.
_POSES, _ITERATIONS = 8, 20
_TINY: dict[str, Any] = {
    "num_envs": 4,
    "size": (16, 16),
    "replay_size": 400,
    "learning_starts": 40,
    "chunk_steps": 80,
    "max_steps": 15,
    "widths": (4, 4, 4),
    "hidden": 16,
    "teacher_hidden": 16,
    "teacher_batch_size": 16,
    "student_batch_size": 8,
    "student_starts": 80,
    "select_every": 160,
    "select_episodes": 4,
}

Row = dict[str, Any]
Write = Callable[[Row], None]


@dataclasses.dataclass(frozen=True)
class Visit:
    """What a cell needs to know.

    Attributes:
      tiny: whether this is a rehearsal at sizes that mean nothing.
      deadline: when the command must be done, by `time.monotonic`.
      ready: called once everything is compiled; returns when it may be measured.
    """

    tiny: bool
    deadline: float
    ready: Callable[[], None] = lambda: None

    def left(self) -> float:
        """Seconds that are left."""
        return self.deadline - time.monotonic()

    def config(self, **options: Any) -> TrainConfig:
        """The preset `gpu` with options changed, or the same of a rehearsal."""
        config = set_train_options(mjx_arm.PRESETS["gpu"], options)
        if not self.tiny:
            return config
        kept = {name: x for name, x in options.items() if name in ("env", "physics", "convolution")}
        return set_train_options(mjx_arm.PRESETS["gpu"], _TINY | kept)


@dataclasses.dataclass(frozen=True)
class Cell:
    """One figure.

    Attributes:
      name: what it is called in its file.
      file: the name of its file, without its ending.
      measure: takes the visit, and a function that writes what is known so far.
      seconds: the least time that it needs; with less it is not begun.
    """

    name: str
    file: str
    measure: Callable[[Visit, Write], None]
    seconds: float


def device(visit: Visit, write: Write) -> None:
    """Versions and device."""
    visit.ready()
    one = jax.devices()[0]
    query = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    # Never a tag, which would not name the commit.
    describe = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--exclude=*"]
    write(
        {
            "devices": jax.device_count(),
            "memory": one.memory_stats() or {},
            "versions": versions("chex", "warp-lang", "jax-cuda12-plugin", "jax-cuda13-plugin"),
            "driver": first_line(query),
            "commit": first_line(describe),
        }
    )


def first_line(command: list[str]) -> str | None:
    """The first line that a command prints; None where it is missing, fails or prints nothing."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=30)
    except (OSError, subprocess.SubprocessError):
        return None
    return next(iter(done.stdout.splitlines()), None)


def parity(visit: Visit, write: Write) -> None:
    """Renderer and physics here beside the stored values of the CPU."""
    visit.ready()
    write(compare(json.loads(STORED.read_text()), compute()))


def compare(stored: Row, now: Row) -> Row:
    """How far a result of `compute` is from the stored ones.

    The physics is compared with that of each stored backend: with the same one, which says what
    the device changes, and with the others.
    """
    images, expected = _decode(now["images"]), _decode(stored["images"])
    same = np.asarray(mjx_arm.segmentation(images)) == np.asarray(mjx_arm.segmentation(expected))
    colours = np.abs(np.asarray(mjx_arm.rgb(images), int) - np.asarray(mjx_arm.rgb(expected), int))[
        same
    ]
    gaps = {
        backend: np.abs(np.asarray(now["qpos"]) - np.asarray(qpos)).max(axis=(1, 2))
        for backend, qpos in stored["qpos"].items()
    }
    return {
        "stored_on": stored["machine"],
        "share_of_pixels_of_another_geom": float(1 - same.mean()),
        "largest_difference_of_colour": int(colours.max(initial=0)),
        "backend": now["backend"],
        "largest_difference_of_qpos": {name: float(gap.max()) for name, gap in gaps.items()},
        "by_iteration": {name: gap.tolist() for name, gap in gaps.items()},
    }


def store() -> Row:
    """What `compare` needs from a CPU: images, and the motion with both backends that run there."""
    native, mjx = compute("native"), compute("mjx")
    return {
        "machine": machine(),
        "images": native["images"],
        "qpos": {"native": native["qpos"], "mjx": mjx["qpos"]},
    }


def compute(physics: str = "auto") -> Row:
    """Images of some starts in B, and a motion of the arm through the air from the same starts."""
    env = mjx_arm.make("B", observation="packed", physics=physics)
    keys = jax.random.split(jax.random.key(11), _POSES)
    flags = compiler_options(env.physics)
    obs, state = jax.jit(jax.vmap(env.reset), compiler_options=flags)(keys)
    actions = jax.random.randint(jax.random.key(12), (_ITERATIONS, _POSES), 0, 6)

    def step(state: Any, action: jax.Array) -> tuple[Any, jax.Array]:
        state = jax.vmap(env.transition)(state, action)[0]
        return state, state.physics.qpos

    run = jax.jit(lambda state: jax.lax.scan(step, state, actions)[1], compiler_options=flags)
    images = base64.b64encode(zlib.compress(np.asarray(obs).tobytes(), 9)).decode()
    return {
        "backend": env.physics.backend,
        "images": {"shape": list(obs.shape), "data": images},
        "qpos": np.asarray(run(state), float).round(7).tolist(),
    }


def _decode(images: Row) -> np.ndarray:
    data = zlib.decompress(base64.b64decode(images["data"]))
    return np.frombuffer(data, np.uint32).reshape(images["shape"])


def train(visit: Visit, write: Write, *, env: str, goal: float, minutes: float) -> None:
    """Trains with the preset `gpu` until the goal or the end of the time; a row each selection."""
    config = visit.config(env=env)
    trainer = make_trainer(config)
    started = time.perf_counter()
    run = trainer.run_chunk.lower(trainer.shapes()).compile()
    judge = make_evaluator(
        trainer.env, trainer.algorithm.apply, episodes=config.select_episodes, epsilon=_EPSILON
    )
    state = trainer.start()
    key = role_key(_SEED, SELECTION)
    # The first of both is no part of the training: compiled and thrown away.
    judge(trainer.algorithm.policy(state.learner), key)
    visit.ready()
    row: Row = {
        "env": env,
        "goal": goal,
        "compile_s": round(time.perf_counter() - started, 1),
        "samples_per_step": config.samples_per_step,
        "judged": [],
        "reached": None,
    }
    write(row)
    end = time.monotonic() + min(60 * minutes, visit.left())
    per_chunk = config.chunk_length * config.num_envs
    started = time.perf_counter()
    for chunk in range(1, config.num_chunks + 1):
        state, counts = run(state)
        counts = jax.device_get(counts)
        late = time.monotonic() > end
        due = chunk * per_chunk // config.select_every
        if due > (chunk - 1) * per_chunk // config.select_every or late:
            trained = time.perf_counter() - started
            result = judge(trainer.algorithm.policy(state.learner), key)
            steps = chunk * per_chunk
            row["judged"].append(
                {
                    "minutes": round((time.perf_counter() - started) / 60, 3),
                    "env_steps": steps,
                    "steps_per_s": round(steps / trained),
                    "rate": result.rate,
                    "ci95": result.ci95,
                    "episodes": result.episodes,
                    "training_rate": float(counts["successes"] / max(counts["episodes"], 1)),
                }
            )
            if result.rate >= goal:
                row["reached"] = row["judged"][-1]
            write(row)
        if late or row["reached"] or (visit.tiny and len(row["judged"]) == 2):
            return


def _length(config: TrainConfig, visit: Visit) -> int:
    return 2 if visit.tiny else max(8, 131_072 // config.num_envs)


def environment(
    visit: Visit,
    write: Write,
    *,
    num_envs: int,
    stage: str = "physics+render",
    physics: str = "auto",
    fence: bool = False,
    size: int = 64,
) -> None:
    """A stage of the environment alone; `fence` computes an image before what reads it."""
    if physics == "mjx-warp" and importlib.util.find_spec("warp") is None:
        write({"left_out": "warp-lang is not installed"})
        return
    num_envs, size = (4, 16) if visit.tiny else (num_envs, size)
    env = mjx_arm.make("B", physics=physics, observation="packed", size=(size, size))
    flags = compiler_options(env.physics)
    reset = jax.jit(jax.vmap(mjx_arm.AutoReset(env).reset), compiler_options=flags)
    obs, state = reset(jax.random.split(jax.random.key(0), num_envs))
    length = 2 if visit.tiny else max(8, 131_072 // num_envs)
    if fence:
        env = _Fenced(**{field.name: getattr(env, field.name) for field in dataclasses.fields(env)})
    run = env_stages(env, num_envs, length)[stage]
    started = time.perf_counter()
    compiled = jax.jit(run, compiler_options=flags).lower((state, obs)).compile()
    compile_s = round(time.perf_counter() - started, 2)
    visit.ready()
    figures = time_chunks(lambda: compiled((state, obs)), num_envs * length, 3)
    about = {"num_envs": num_envs, "size": size, "backend": env.physics.backend}
    write({**about, **figures, "compile_s": compile_s})


class _Fenced(mjx_arm.Env):
    """An environment whose image is computed before anything that reads it."""

    def observe(self, state: mjx_arm.EnvState) -> Any:
        """What `Env.observe` returns."""
        return jax.lax.optimization_barrier(super().observe(state))


def training(
    visit: Visit, write: Write, *, num_envs: int, precision: str = "", **options: Any
) -> None:
    """The whole loop once it learns, and its memory beside the plan."""
    at_once = {"learning_starts": 0, "student_starts": 0, "student_warm_up": 0}
    base = {} if "algorithm" in options else at_once
    config = visit.config(num_envs=num_envs, **(base | options))
    config = set_train_options(config, {"chunk_steps": _length(config, visit) * config.num_envs})
    with jax.default_matmul_precision(precision) if precision else contextlib.nullcontext():
        compiled = compile_training(config)
        visit.ready()
        figures = time_training(compiled, 1 if visit.tiny else 3)
    write({"num_envs": config.num_envs, "options": options, **figures})
    if not options:
        write(peak_memory(compiled))


def _with_own_ratio(num_envs: int) -> dict[str, int]:
    """Batches with which each environment step has as many samples as in the preset `gpu`."""
    preset = mjx_arm.PRESETS["gpu"]
    return {
        name: getattr(preset.algo, name) * num_envs // preset.num_envs
        for name in ("teacher_batch_size", "student_batch_size")
    }


def _cells() -> dict[str, list[Cell]]:
    """The cells of each command, in their order."""
    part = functools.partial
    first = [
        Cell("device", "device", device, 1),
        Cell("parity", "parity", parity, 20),
        Cell("a", "train-a", part(train, env="A", goal=0.95, minutes=4.0), 270),
    ]
    many = 8_192
    for num_envs in (many, 1_024):
        first += [
            Cell(
                f"physics+render at {num_envs}",
                "throughput",
                part(environment, num_envs=num_envs),
                60,
            ),
            Cell(
                f"training and driving at {num_envs}",
                "throughput",
                part(training, num_envs=num_envs),
                90,
            ),
        ]
        if num_envs == many:
            measure = part(training, num_envs=many, **_with_own_ratio(many))
            name = f"training and driving at {many} with the preset's samples a step"
            first.append(Cell(name, "throughput", measure, 90))
    # Each beside the cell above that differs in this alone.
    patches = part(training, num_envs=many, convolution="patches")
    highest = part(training, num_envs=many, precision="highest")
    fenced = part(environment, num_envs=many, fence=True)
    first += [
        Cell("convolution patches", "comparisons", patches, 90),
        Cell("precision highest", "comparisons", highest, 90),
        Cell("ray cast fenced", "comparisons", fenced, 60),
    ]
    for physics in ("mjx", "mjx-warp"):
        measure = part(environment, num_envs=many, stage="physics", physics=physics)
        first.append(Cell(f"physics {physics}", "comparisons", measure, 60))
    # Squint (arXiv 2602.21203): 1,024 environments, images of 16 by 16, a replay of 1 M and 256
    # updates of 512 in each 1,024 steps, discount 0.9. Theirs is SAC; ours is DQN.
    squint = {
        "algorithm": "dqn",
        "size": (16, 16),
        "replay_size": 1_048_576,
        "storage": "pixels",
        "batch_size": 512,
        "updates_per_step": 256,
        "gamma": 0.9,
        "learning_starts": 0,
    }
    published = [
        # Playground's PandaPickCubeCartesian has 1,024 environments of 64 by 64 pixels, like a cell
        # of the first command; its physics alone is this one.
        Cell(
            "playground, physics",
            "published",
            part(environment, num_envs=1_024, stage="physics"),
            60,
        ),
        Cell("squint", "published", part(training, num_envs=1_024, **squint), 90),
    ]
    b = [Cell("b", "train-b", part(train, env="B", goal=1.1, minutes=8.0), 270)]
    return {"": first, "b": b, "published": published}


CELLS = _cells()
# A program's kernels are tried on the GPU before most of the compiling, which needs cores alone: so
# long the next one waits, that few are tried beside another's.
_APART_S = 6
# What a process prints when it only waits for its turn.
_READY = "compiled"
# So long a cell may go on after the minutes of a command, which with the default ends before 9.
_GRACE_S = 20


def measure_ahead(folder: pathlib.Path, cells: list[Cell], visit: Visit) -> None:
    """Compiles the programs of all cells in parallel; then measures one cell after another.

    Args:
      folder: for the results.
      cells: each gets a process of its own.
      visit: two thirds of its time may pass until a program is compiled, or its cell is left out.
    """
    # Each takes the memory that it needs, not most of it.
    environment = os.environ | {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    compiled_by = visit.deadline - visit.left() / 3
    command = [sys.executable, __file__, "--json", str(folder), *["--tiny"] * visit.tiny]
    begun = []
    for cell in cells:
        minutes = str(max(visit.left(), 0) / 60)
        begun.append(
            subprocess.Popen(
                [*command, "--wait", "--minutes", minutes, "--cells", cell.name],
                env=environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
        )
        time.sleep(0 if visit.tiny else _APART_S)
    with contextlib.ExitStack() as stack:
        for process in begun:
            stack.enter_context(process)
            stack.callback(process.kill)
        ready = [said(process, _READY, compiled_by - time.monotonic()) for process in begun]
        # What still compiles would disturb what is measured.
        for process, is_ready in zip(begun, ready, strict=True):
            if not is_ready:
                process.kill()
        for cell, process, is_ready in zip(cells, begun, ready, strict=True):
            started = time.monotonic()
            if not is_ready:
                print(f"{cell.name}: not compiled in time, or it failed", flush=True)
                continue
            if visit.left() < cell.seconds / 3:
                print(f"{cell.name}: left out, {visit.left():.0f} s are left", flush=True)
                continue
            try:
                # Also where it has died meanwhile.
                process.communicate("go\n", visit.left() + _GRACE_S)
            except subprocess.TimeoutExpired:
                print(f"{cell.name}: not measured in time", flush=True)
                continue
            print(f"{cell.name}: {time.monotonic() - started:.0f} s", flush=True)


def said(process: subprocess.Popen[str], line: str, seconds: float) -> bool:
    """Whether a process prints this line before the seconds are over and before it ends."""
    found = threading.Event()
    done = threading.Event()

    def listen() -> None:
        for printed in process.stdout or ():
            if printed.rstrip() == line:
                found.set()
                break
        done.set()

    threading.Thread(target=listen, daemon=True).start()
    done.wait(max(seconds, 0))
    return found.is_set()


def wait_for_turn() -> None:
    """Says that everything is compiled and waits until it is this process's turn."""
    print(_READY, flush=True)
    sys.stdin.readline()


def read(folder: pathlib.Path, file: str) -> list[Row]:
    """The rows of a file of results."""
    path = folder / f"{file}.json"
    return json.loads(path.read_text())["rows"] if path.is_file() else []


def append(folder: pathlib.Path, cell: Cell, *, ahead: bool = False) -> Write:
    """A function that writes a new row of a cell, and adds to it when it is called again."""
    before: list[Row] = []
    about, latest = Row(), Row()

    def write(row: Row) -> None:
        if not about:
            # Not earlier: with `--ahead` other processes write while this one waits.
            before.extend(read(folder, cell.file))
            now = time.strftime("%Y-%m-%d %H:%M:%S")
            about.update({"cell": cell.name, "machine": machine(), "at": now})
            if ahead:
                # `compile_s` is then a time beside others that compile.
                about["compiled_ahead"] = True
        latest.update(row)
        rows = [*before, about | latest]
        folder.mkdir(parents=True, exist_ok=True)
        part = folder / f"{cell.file}.part"
        part.write_text(json.dumps({"rows": rows}, indent=1) + "\n")
        part.replace(folder / f"{cell.file}.json")

    return write


def has_figure(row: Row) -> bool:
    """Whether a row says what was measured, even if the cell failed after that."""
    if "judged" in row:
        return bool(row["judged"])
    return "steps_per_s" in row or not {"failed", "left_out"} & set(row)


def in_order(folder: pathlib.Path, cells: list[Cell]) -> Iterator[Cell]:
    """The cells, those with the fewest figures first."""
    figures = {
        cell.name: sum(
            row["cell"] == cell.name and has_figure(row) for row in read(folder, cell.file)
        )
        for cell in cells
    }
    # Python's sort keeps the order of equal ones.
    yield from sorted(cells, key=lambda cell: figures[cell.name])


def main(arguments: list[str] | None = None) -> None:
    """Measures the cells of a command until its time is over."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=pathlib.Path, help="folder for the results")
    parser.add_argument("--only", choices=[name for name in CELLS if name], default="")
    parser.add_argument("--cells", nargs="+", help="these cells, of any command")
    parser.add_argument("--minutes", type=float, default=8.5, help="begin and train no longer")
    parser.add_argument("--tiny", action="store_true", help="rehearse at sizes that mean nothing")
    parser.add_argument("--ahead", action="store_true", help="compile all cells in parallel first")
    parser.add_argument("--wait", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--store", action="store_true", help=f"write {STORED.name} from a CPU")
    options = parser.parse_args(arguments)
    visit = Visit(options.tiny, time.monotonic() + 60 * options.minutes)
    if options.wait:
        visit = dataclasses.replace(visit, ready=wait_for_turn)
    if options.store:
        if jax.default_backend() != "cpu":
            parser.error("--store keeps the values of a CPU: set JAX_PLATFORMS=cpu")
        STORED.write_text(json.dumps(store()) + "\n")
        return
    if options.json is None:
        parser.error("--json must be a folder for the results, got none")
    cells = CELLS[options.only]
    if options.cells:
        cells = [cell for command in CELLS.values() for cell in command]
        unknown = set(options.cells) - {cell.name for cell in cells}
        if unknown:
            parser.error(
                f"--cells must be some of {[x.name for x in cells]}, got {sorted(unknown)}"
            )
        cells = [cell for cell in cells if cell.name in options.cells]
    cells = list(in_order(options.json, cells))
    if options.ahead:
        measure_ahead(options.json, cells, visit)
        return
    ending = threading.Timer(visit.left() + _GRACE_S, _end)
    ending.daemon = True
    ending.start()
    for cell in cells:
        if not options.wait and visit.left() < cell.seconds:
            print(f"{cell.name}: left out, {visit.left():.0f} s are left", flush=True)
            continue
        started, write = time.monotonic(), append(options.json, cell, ahead=options.wait)
        try:
            cell.measure(visit, write)
        except (jax.errors.JaxRuntimeError, ValueError) as error:
            # One cell that does not fit the device must not cost the others.
            write({"failed": " ".join(str(error).split())[:300]})
        print(f"{cell.name}: {time.monotonic() - started:.0f} s", flush=True)
    ending.cancel()


def _end() -> None:
    """Ends the command, whose results are on disk, in the middle of whatever takes too long."""
    print("out of time: the last cell is not finished", flush=True)
    os._exit(0)


if __name__ == "__main__":
    main()
