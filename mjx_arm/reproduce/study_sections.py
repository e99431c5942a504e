"""The parts of the page about studies: the reward, the preset `paper`, ablations."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from mjx_arm.report.run_page import duration, interval, percent
from mjx_arm.reproduce.agent_sections import missing_cells
from mjx_arm.reproduce.blocks import Block, Heading, Missing, Picture, Source, Table, Text
from mjx_arm.reproduce.plan import Plan, strongest_ablations
from mjx_arm.reproduce.plots import draw_effects, draw_heights, draw_study
from mjx_arm.reproduce.store import Measured
from mjx_arm.reproduce.trainings import ABLATION_MINUTES, ABLATIONS, DEFAULT, REWARDS, Ablation
from mjx_arm.tools.compare import share_of
from mjx_arm.training.evaluate import newcombe_interval


def reward(plan: Plan) -> Iterator[Block]:
    """The published reward beside the default one."""
    yield Heading("The reward")
    yield Text(
        "In the published reward a step with a grasped cube pays 1 + its height in metres, and "
        "success pays 100 once and ends the episode. Holding the cube just below 30 cm for ever is "
        "then worth (1 + height) / (1 - γ), which at γ = 0.99 is more than 100. At γ = 0.98 it is "
        "less. The runs below differ in the reward and γ alone."
    )
    found = {name: _of_reward(plan, name) for name in REWARDS}
    found = {name: each for name, each in found.items() if each}
    if found:
        yield from _reward_figures(found)
    names = [cell.name for cell in plan.cells if cell.section == "reward"]
    yield from missing_cells(plan, names, "The reward")


def _of_reward(plan: Plan, name: str) -> list[Measured]:
    names = [cell.name for cell in plan.cells if cell.name.startswith(f"reward-{name}-seed")]
    return [found for each in names if (found := plan.read(each)) is not None]


def _reward_figures(found: dict[str, list[Measured]]) -> Iterator[Block]:
    yield Table(
        ("reward", "hovering is worth", "success is worth", "so it pays to", "mean Q reached"),
        tuple(_worth(name, cells) for name, cells in found.items()),
    )
    rows = []
    for name, cells in found.items():
        for each in cells:
            result = each.result
            heights = result["heights"]
            rows.append(
                (
                    f"{REWARDS[name][1]}, seed {result['train_seed']}",
                    percent(result["rate"]),
                    interval(*result["ci95"]),
                    percent(_share(heights["grasped_steps"], heights["all_steps"])),
                    percent(_share(heights["hovering_steps"], heights["all_steps"])),
                    percent(result["held_not_lifted"] / result["episodes"]),
                )
            )
    yield Table(
        ("trained on", "success in A", "95 % interval", "steps with a grasp", "steps of hovering",
         "held, not lifted"),
        tuple(rows),
    )  # fmt: skip
    yield Text(
        "Hovering: the cube is grasped and more than 20 cm high in an episode that fails. The last "
        "agent of each run is judged, not the best one, with one action in ten random."
    )
    labels = {name: REWARDS[name][1].partition(":")[0].replace("`", "") for name in found}
    curves = {labels[name]: [x.result["curve"] for x in cells] for name, cells in found.items()}
    yield Picture(
        "reward-curves.svg",
        draw_study(curves, goal=100.0),
        "Success and mean maximum Q of the trainings on each reward over environment steps",
        "Q-values are divided by the scale of the reward. Where they pass the reward of success, "
        "the agent expects more from waiting than from finishing.",
    )
    heights = {labels[name]: [x.result["heights"] for x in cells] for name, cells in found.items()}
    yield Picture(
        "reward-heights.svg",
        draw_heights(heights, 0.3),
        "Histograms of the cube's height while it is grasped, one for each reward",
        "Where the cube is while it is grasped. The dotted line is the goal, 30 cm.",
    )
    yield Source(tuple(x.file for cells in found.values() for x in cells))


def _share(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")


def _worth(name: str, cells: list[Measured]) -> tuple[str, ...]:
    result = cells[0].result
    worth = result["worth"]
    hover, success = worth["hovering_for_ever"], worth["success"]
    reached = [x for cell in cells if (x := _last_q(cell.result["curve"])) is not None]
    return (
        REWARDS[name][1].partition(":")[0],
        f"{worth['a_step_of_hovering']:.3f} / (1 - {result['gamma']:g}) = {hover:.1f}",
        f"{success:g}",
        "hover" if hover > success else "finish",
        f"{max(reached):.1f}" if reached else "no episode ended",
    )


def _last_q(curve: dict[str, Any]) -> float | None:
    known = [x for x in curve["mean_max_q"] if x is not None]
    return known[-1] if known else None


def paper(plan: Plan) -> Iterator[Block]:
    """The preset `paper` in A, as far as its schedule of epsilon goes."""
    yield Heading("The preset `paper`")
    yield Text(
        "Every value that the paper states, in environment A, for 1,000,000 iterations: its "
        "schedule of ε ends there. The last agent is judged, not the best one."
    )
    found = plan.read("paper-A")
    if found is None:
        yield from missing_cells(plan, ["paper-A"], "The preset `paper`")
        return
    rows = []
    for name, trial in found.result["trials"].items():
        rows.append(
            (
                "greedy" if name == "greedy" else "ε = 0.1",
                percent(trial["rate"]),
                interval(*trial["ci95"]),
                f"{trial['episodes']:,}",
                percent(trial["held_not_lifted"] / trial["episodes"]),
                percent(trial["causes"]["never_reached"] / trial["episodes"]),
            )
        )
    yield Table(
        ("judged", "success", "95 % interval", "episodes", "held, not lifted", "never reached"),
        tuple(rows),
    )
    curve = found.result["curve"]
    yield Picture(
        "paper-curves.svg",
        draw_study({"preset paper": [curve]}, goal=100.0),
        "Success and mean maximum Q of the preset paper over environment steps",
        f"{curve['env_steps'][-1]:,} steps in {duration(curve['wall_s'])} of training.",
    )
    yield Source((found.file,))


def ablations(plan: Plan) -> Iterator[Block]:
    """What the parts of the default preset are worth."""
    yield Heading("What matters")
    length = "a tiny training" if plan.quick else f"{ABLATION_MINUTES:g} minutes of training"
    yield Text(
        f"The default preset with one thing changed, in environment A, {length} each on the same "
        "machine, one seed. Another seed may differ by more than the interval, which is over "
        "episodes."
    )
    for env in ("A", "B"):
        names = [None, *ABLATIONS] if env == "A" else _repeated(plan)
        yield from _ablation_table(plan, env, names)
    if not strongest_ablations(plan.store, plan.cells):
        yield Missing(
            "The three strongest changes are tried again in B once all of A are measured.",
            plan.command("ablations", "ablations-B"),
        )
    yield from missing_cells(
        plan,
        [cell.name for cell in plan.cells if cell.section in ("ablations", "ablations-B")],
        "What matters",
    )


def _repeated(plan: Plan) -> list[Ablation | None]:
    strongest = strongest_ablations(plan.store, plan.cells)
    return [None, *(each for each in ABLATIONS if each.name in strongest)] if strongest else []


def _ablation_table(plan: Plan, env: str, names: list[Ablation | None]) -> Iterator[Block]:
    default = plan.read(f"ablation-{env}-{DEFAULT}")
    rows, effects, files, said = [], [], [], []
    for ablation in names:
        name = DEFAULT if ablation is None else ablation.name
        title = "the default preset" if ablation is None else ablation.title
        found = plan.read(f"ablation-{env}-{name}")
        if found is None:
            if ablation is not None and ablation.changes is None:
                said.append(f"Not tried: {title}. No option of this version makes it.")
            continue
        files.append(found.file)
        result = found.result
        change = None
        if default is not None and found.name != default.name:
            change = _difference(result, default.result)
            effects.append((title.partition(" instead")[0], *change))
        share = share_of([(result["successes"], result["episodes"])])
        assert share is not None
        rows.append(
            (
                title,
                percent(result["rate"]),
                interval(share.low, share.high),
                "–" if change is None else _points(*change),
                f"{result['env_steps']:,}",
                "the reference" if ablation is None else _verdict(change),
            )
        )
    if rows:
        yield Heading(f"Environment {env}", 3)
        head = ("change", "success", "95 % interval", "minus the default", "steps", "in words")
        yield Table(head, tuple(rows))
    if effects:
        yield Picture(
            f"ablations-{env}.svg",
            draw_effects(effects),
            f"Success of each change minus that of the default preset in environment {env}",
            "Newcombe's 95 % intervals over the episodes of one seed each.",
        )
    for sentence in said:
        yield Text(sentence)
    if files:
        yield Source(tuple(files))


def _difference(result: dict[str, Any], default: dict[str, Any]) -> tuple[float, float, float]:
    low, high = newcombe_interval(
        result["successes"], result["episodes"], default["successes"], default["episodes"]
    )
    return result["rate"] - default["rate"], low, high


def _points(middle: float, low: float, high: float) -> str:
    return f"{100 * middle:+.1f} ({100 * low:+.1f} to {100 * high:+.1f})"


def _verdict(change: tuple[float, float, float] | None) -> str:
    if change is None:
        return "The default is not measured yet."
    _, low, high = change
    if high < 0:
        return "Worse than the default in this seed."
    if low > 0:
        return "Better than the default in this seed."
    return "No clear difference."
