"""The tables of the page of benchmarks, made from the files in `benchmarks/results`.

As an extension of Sphinx this adds the directive `results`, whose argument names a table.
"""

from __future__ import annotations

import json
import pathlib
import statistics
from collections.abc import Callable, Sequence
from typing import Any

RESULTS = pathlib.Path(__file__).parents[1] / "benchmarks" / "results"


def render(name: str, folder: pathlib.Path = RESULTS) -> str:
    """A table in Markdown, with the machine and the file below it.

    Args:
      name: of the table, one of `TABLES`.
      folder: with the files.

    Raises:
      ValueError: there is no such table.
    """
    if name not in TABLES:
        raise ValueError(f"results must name one of {', '.join(TABLES)}, got {name!r}")
    file, make = TABLES[name]
    content = _read(folder / file)
    header, rows = make(content)
    lines = [header, ["---"] * len(header), *rows]
    table = "\n".join(f"| {' | '.join(str(x) for x in line)} |" for line in lines)
    kind = "Files" if file in FOLDERS else "File"
    return f"{table}\n\n{_machine(content)}{kind}: `benchmarks/results/{file}`."


def _read(path: pathlib.Path) -> Any:
    """The content of a file, or of each file of a folder by its stem.

    A folder may be missing, and is empty then.

    Raises:
      FileNotFoundError: another file is missing.
    """
    if path.name in FOLDERS:
        return {each.stem: _read(each) for each in sorted(path.glob("*.json"))}
    return json.loads(path.read_text(encoding="utf-8"))


Table = tuple[list[str], list[list[str]]]


def _throughput(content: Any) -> Table:
    columns = {
        "physics": ("physics", False),
        "rendering": ("render", False),
        "both": ("physics+render", False),
        "rendering, shadows": ("render", True),
        "both, shadows": ("physics+render", True),
    }
    rates = {
        (row["num_envs"], row["stage"], row["shadows"]): row["steps_per_s"]
        for row in content["rows"]
    }
    measured = {key[1:] for key in rates}
    columns = {name: column for name, column in columns.items() if column in measured}
    return (
        ["environments", *(f"{name}, steps/s" for name in columns)],
        [
            [f"{n:,}", *(_number(rates.get((n, *column))) for column in columns.values())]
            for n in _sizes(content)
        ],
    )


def _train(content: Any) -> Table:
    cells = {(r["num_envs"], r["stage"], r["storage"]): r for r in content["rows"]}
    header = ["environments", "acting, steps/s", "updates of 64 per s"]
    for storage in ("states", "pixels"):
        header += [f"training, replay of {storage}, steps/s", "memory, MB"]
    rows = []
    for n in _sizes(content):
        row = [f"{n:,}", *(_number(cells[n, x, "states"]["steps_per_s"]) for x in ("act", "learn"))]
        for storage in ("states", "pixels"):
            cell = cells[n, "train", storage]
            row += [_number(cell["steps_per_s"]), _number(cell["peak_bytes"] / 1e6)]
        rows.append(row)
    return header, rows


def _peers(content: Any) -> Table:
    kinds = {
        "env": "environment steps",
        "act": "observations acted on",
        "update": "updates of 64",
        "train": "environment steps, trained",
    }
    rows = []
    for name, rounds in content["per_second"].items():
        kind, what = name.split("/", 1)
        span = f"{_number(min(rounds))} to {_number(max(rounds))}"
        rows.append([what, kinds[kind], _number(statistics.median(rounds)), span])
    return ["what", "counted", "per second, median", "all rounds"], rows


def _peer_ratios(content: Any) -> Table:
    rows = [[name.replace(" / ", " against "), f"{x:.2f}"] for name, x in _ratios(content)]
    return ["pair", "median of the ratios"], rows


def _ratios(content: Any) -> list[tuple[str, float]]:
    return list(content["median_ratios"].items())


def _profile(content: Any) -> Table:
    rows = [[r["stage"], f"{r['ms']:.1f}", f"{r['floor_ms']:.1f}"] for r in content["rows"]]
    return ["stage", "ms", "least possible, ms"], rows


def _overhead(content: Any) -> Table:
    rows = [
        [f"{r['num_envs']:,}", *(_number(r["median"][x]) for x in ("native", "loop"))]
        for r in content["rows"]
    ]
    return ["environments", "`native` in a scan, steps/s", "loop of `mujoco.batch`, steps/s"], rows


def _seconds(content: Any) -> Table:
    rows = [
        [name, f"{x:.1f}", ", ".join(f"{each:.1f}" for each in content["all"][name])]
        for name, x in content["median"].items()
    ]
    return ["start", "median, s", "each, s"], rows


def _time_to_success(content: Any) -> Table:
    rows = []
    for result in content["results"]:
        last = result["judged"][-1]
        reached = "yes" if result["reached"] else "no"
        rows.append(
            [
                result["learner"],
                reached,
                f"{last['minutes']:.0f}",
                f"{last['env_steps']:,}",
                f"{100 * last['rate']:.0f} %",
                f"{result['machine']['cpu']}, threads: {result['machine']['threads']}",
            ]
        )
    goal = f"reached {100 * content['goal']:.0f} %"
    return ["learner", goal, "minutes", "steps", "success then", "machine"], rows


def _before_after(content: Any) -> Table:
    rows = [
        [
            row["stage"],
            _number(row["before"]),
            _number(row["after"]),
            f"{row['ratio']:.2f} ({row['low']:.2f} to {row['high']:.2f})",
        ]
        for row in content["rows"]
    ]
    before, after = (content["commits"][x] for x in ("before", "after"))
    return [
        "stage, backend, environments",
        f"before, per s (commit `{before}`)",
        f"after, per s (commit `{after}`)",
        "ratio (interval)",
    ], rows


def _tasks(content: Any) -> Table:
    rows = []
    for row in content["rows"]:
        judged, about, config = row["evaluation"], row["machine"], row["config"]
        low, high = (100 * x for x in judged["ci95"])
        rows.append(
            [
                row["task"],
                f"{row['minutes']:.1f}",
                f"{100 * judged['rate']:.1f} % ({low:.1f} to {high:.1f})",
                f"{about['cpu']}, {about['cores']} cores, {_versions(about)}",
                f"`{task_command(config)}`",
            ]
        )
    return ["task", "minutes", "success (95 % interval)", "machine", "training"], rows


def task_command(config: Any) -> str:
    """The command that trains with a configuration of `benchmarks/tasks.py`."""
    env = config["env"]
    return (
        f"mjx-arm train --preset state --task {env['task']} --env {env['env']} "
        f"--total-steps {config['total_steps']}"
    )


def _desk(content: Any) -> Table:
    rows = []
    for row in content["rows"]:
        cells = [row["variant"]]
        for stage in ("render", "step"):
            if stage not in row:
                cells += ["not measured"] * 2
                continue
            cell = row[stage]
            cells += [f"{cell['ratio']:.2f} ({cell['least']:.2f} to {cell['most']:.2f})"]
            cells += [_number(cell["per_s"])]
        rows.append(cells)
    return ["variant", "images, of plain", "images/s", "steps, of plain", "steps/s"], rows


def _gpu(content: Any) -> Table:
    rows = [
        _to_success(content, "train-a", 0.95, "environment A to 95 %", 3),
        _to_success(content, "train-b", 0.90, "environment B to 90 %", 5),
    ]
    for number in (8_192, 1_024):
        cell = f"training and driving at {number}"
        rows += [
            _rate(content, f"physics+render at {number}", _of("physics and rendering", number)),
            _rate(content, cell, _of("training", number)),
            _memory(content, cell, _of("memory of the training", number)),
        ]
        if number == 8_192:
            rows[-3][1] = "400,000 steps/s"
            # It was measured when the cell was called so.
            before = "training of 8,192 environments before the student drives"
            rows.append(_rate(content, f"training at {number}", before))
            own = f"{cell} with the preset's samples a step"
            rows.append(_rate(content, own, "training of 8,192 environments, larger batches"))
            rows[-1][1] = "100,000 steps/s"
    rows += [_whole(content, "train-a", "A"), _whole(content, "train-b", "B"), _parity(content)]
    training = "training of 8,192 environments"
    for cell, what, file in (
        ("convolution patches", f"{training}, patches in place of `nn.Conv`", "comparisons"),
        ("precision highest", f"{training}, the highest precision of matrices", "comparisons"),
        (
            "ray cast fenced",
            "physics and rendering of 8,192 environments, images not fused with what reads them",
            "comparisons",
        ),
        ("physics mjx", "physics alone of 8,192 environments, MJX", "comparisons"),
        ("physics mjx-warp", "physics alone of 8,192 environments, MJX-Warp", "comparisons"),
        (
            "playground, physics",
            "physics alone of 1,024 environments, as many as Playground's",
            "published",
        ),
        ("squint", "training with Squint's published settings", "published"),
    ):
        rows.append(_rate(content, cell, what, file))
    return ["what", "goal", "measured", "device"], rows


def _of(what: str, number: int) -> str:
    return f"{what} of {number:,} environments"


def _to_success(content: Any, file: str, goal: float, what: str, minutes: int) -> list[str]:
    """A row of the trainings of a file: when each first reached a rate of success."""
    rows = _measured(content, file)
    said = []
    for row in rows:
        reached = [each for each in row["judged"] if each["rate"] >= goal]
        if reached:
            said.append(f"{reached[0]['minutes']:.1f} minutes")
        elif row["judged"]:
            best = max(each["rate"] for each in row["judged"])
            said.append(f"{100 * best:.0f} % in {row['judged'][-1]['minutes']:.1f} minutes")
    return [what, f"{minutes} minutes", *_cells_of(said, rows)]


def _rate(content: Any, cell: str, what: str, file: str = "throughput") -> list[str]:
    """A row of the steps per second of a cell."""
    rows = [row for row in _measured(content, file) if row["cell"] == cell]
    rows = [row for row in rows if "steps_per_s" in row]
    said = []
    for row in rows:
        samples = row.get("samples_per_step")
        per_step = "" if samples is None else f" with {samples:g} samples for each step"
        said.append(f"{_number(row['steps_per_s'])} steps/s{per_step}")
    return [what, "", *_cells_of(said, rows)]


def _memory(content: Any, cell: str, what: str) -> list[str]:
    """A row of what a training held on the device, beside the plan that it had printed."""
    rows = [row for row in _measured(content, "throughput") if row["cell"] == cell]
    rows = [row for row in rows if "peak_bytes" in row]
    said = [f"{row['peak_bytes'] / 1e9:.2f} GB" for row in rows]
    planned = sorted({f"{row['planned_bytes'] / 1e9:.2f} GB planned" for row in rows})
    return [what, ", ".join(planned), *_cells_of(said, rows)]


def _whole(content: Any, file: str, env: str) -> list[str]:
    """A row of the speed of the trainings of a file, from their first evaluation to their last."""
    said, rows = [], _measured(content, file)
    for row in rows:
        judged = row["judged"]
        if len(judged) > 1:
            steps = judged[-1]["env_steps"] - judged[0]["env_steps"]
            rate = steps / (60 * (judged[-1]["minutes"] - judged[0]["minutes"]))
            said.append(f"{_number(rate)} steps/s")
    what = f"a whole training in {env}, with the evaluations between its steps"
    return [what, "100,000 steps/s", *_cells_of(said, rows)]


def _parity(content: Any) -> list[str]:
    """A row of how far images and a motion are from the stored ones of a CPU."""
    rows = _measured(content, "parity")
    said = [
        f"{100 * row['share_of_pixels_of_another_geom']:.3f} % of the pixels show another geom, "
        f"the others differ by {row['largest_difference_of_colour']} of 255 at most; qpos by "
        f"{max(row['largest_difference_of_qpos'].values()):.0e} rad or m after 20 iterations"
        for row in rows
    ]
    return ["images and a motion beside those of a CPU", "equal", *_cells_of(said, rows)]


def _measured(content: Any, file: str) -> list[Any]:
    """The rows of a file of `gpu.py` without those that failed before they had a figure."""
    rows = content.get(file, {"rows": []})["rows"]
    return [row for row in rows if "failed" not in row or {"steps_per_s", "judged"} & set(row)]


def _cells_of(said: list[str], rows: list[Any]) -> list[str]:
    """All figures of a row, none left out, and the devices that they were taken on."""
    if not said:
        return ["not measured", "not measured"]
    return [", ".join(said), ", ".join(sorted({row["machine"]["device"] for row in rows}))]


def _processes(content: Any) -> Table:
    measured = {row["variant"]: row for row in content.get("rows", [])}
    rows = []
    for variant in ("1 process, 1 core", "1 process, 2 cores", "2 processes, a core each"):
        if variant not in measured:
            rows.append([variant, *["not measured"] * 3])
            continue
        row = measured[variant]
        span = f"{_number(row['least'])} to {_number(row['most'])}"
        exchange = row["exchange"]
        share = "nothing to exchange" if exchange is None else f"{100 * exchange:.0f} %"
        rows.append([variant, _number(row["steps_per_s"]), span, share])
    return ["what", "steps/s, median", "all rounds", "share of the time for the exchange"], rows


def _agents(content: Any) -> Table:
    rows = []
    for name, row in content.items():
        low, high = row["mjx_minus_native"]["ci95"]
        own, scripted = (row[f"median_length_{which}"] for which in ("agent", "scripted"))
        rows.append(
            [
                f"`{name}`",
                row["trained_in"],
                *(f"{100 * row[f'in_{env}']['rate']:.1f} %" for env in ("A", "B")),
                f"{own:g}; {scripted:g}",
                f"{row['mjx_minus_native']['percent']:.1f} points ({low:.1f} to {high:.1f})",
                f"{100 * row['blank_image']:g} %; {100 * row['image_of_another_episode']:g} %",
                f"{row['machine']['cpu']}, {row['machine']['cores']} cores, "
                f"{_versions(row['machine'])}",
            ]
        )
    header = ["agent", "trained in", "success in A", "success in B"]
    header += ["median length of a success: agent; scripted policy"]
    header += [
        "MJX minus native physics (95 % interval)",
        "blank image; another episode's image",
        "machine",
    ]
    return header, rows


def _sizes(content: Any) -> list[int]:
    return sorted({row["num_envs"] for row in content["rows"]})


def _number(value: float | None) -> str:
    return "not measured" if value is None else f"{value:,.0f}"


def _machine(content: Any) -> str:
    machine = content.get("machine")
    if machine is None:
        return ""
    return f"Machine: {machine['cpu']}, {machine['cores']} cores, {_versions(machine)}. "


def _versions(machine: Any) -> str:
    """Versions of the packages that a file names; older files do not name mjx_arm's."""
    names = ("mjx_arm", "jax", "mujoco", "torch")
    return ", ".join(f"{name} {machine[name]}" for name in names if name in machine)


TABLES: dict[str, tuple[str, Callable[[Any], Table]]] = {
    "throughput": ("throughput.json", _throughput),
    "throughput-mjx": ("throughput_mjx.json", _throughput),
    "train": ("throughput_train.json", _train),
    "peers": ("peers.json", _peers),
    "peer-ratios": ("peers.json", _peer_ratios),
    "profile": ("profile.json", _profile),
    "overhead": ("native_overhead.json", _overhead),
    "tasks": ("tasks.json", _tasks),
    "before-after": ("before_after.json", _before_after),
    "desk": ("desk.json", _desk),
    "cold-start": ("cold_start.json", _seconds),
    "smoke": ("smoke.json", _seconds),
    "time-to-success": ("time_to_success_2_cores.json", _time_to_success),
    "time-to-success-1": ("time_to_success.json", _time_to_success),
    "gpu": ("gpu", _gpu),
    "processes": ("processes.json", _processes),
    "agents": ("agents.json", _agents),
}
# What `benchmarks/gpu.py` wrote. Git keeps no empty folder, so a missing one is an empty one.
FOLDERS = ("gpu",)


def setup(app: Any) -> dict[str, bool]:
    """Adds the directive to Sphinx."""
    from docutils import nodes
    from sphinx.util.docutils import SphinxDirective

    class Results(SphinxDirective):
        """A table by its name."""

        required_arguments = 1

        def run(self) -> Sequence[nodes.Node]:
            name = self.arguments[0]
            self.env.note_dependency(str(RESULTS / TABLES[name][0]))
            return self.parse_text_to_nodes(render(name))

    app.add_directive("results", Results)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
