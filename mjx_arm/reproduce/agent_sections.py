"""The parts of the page about agents: Figures 1 to 4, Table 1, re-grasping, failures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from mjx_arm.report.run_page import interval, percent
from mjx_arm.reproduce import james_johns
from mjx_arm.reproduce.blocks import Block, Heading, Missing, Picture, Source, Table, Text
from mjx_arm.reproduce.curves import REGULAR_EPISODES
from mjx_arm.reproduce.plan import Plan, trial_of
from mjx_arm.reproduce.plots import (
    draw_figure3,
    draw_figure4,
    draw_joints,
    draw_network,
    draw_places,
)
from mjx_arm.reproduce.records import CAUSES
from mjx_arm.reproduce.scenes import SCENES
from mjx_arm.reproduce.store import Measured
from mjx_arm.reproduce.subjects import WAYS, Subject
from mjx_arm.tools.compare import share_of
from mjx_arm.training.evaluate import wilson_interval


def missing_cells(plan: Plan, names: Iterable[str], what: str) -> Iterator[Block]:
    """The cells that have no file, and the command that fills them."""
    missing = [name for name in names if plan.read(name) is None]
    if missing:
        listed = ", ".join(f"`{name}`" for name in missing)
        section = next(cell.section for cell in plan.cells if cell.name == missing[0])
        short = [section] if missing == _names(plan, section) else missing
        yield Missing(f"{what}. Not measured yet: {listed}.", plan.command(*short))


def _names(plan: Plan, section: str) -> list[str]:
    return [cell.name for cell in plan.cells if cell.section == section]


def stored(plan: Plan, name: str, alt: str, caption: str = "", *, wide: bool = False) -> Picture:
    """A picture that a cell has left."""
    return Picture(name, plan.store.picture(name), alt, caption, wide)


def figure1(plan: Plan) -> Iterator[Block]:
    """The scenes, by both renderers."""
    yield Heading("Figure 1: the scenes")
    for scene in SCENES:
        name = f"figure1-{scene}"
        if name not in _names(plan, "figure1"):
            yield Text(f"The scene `{scene}` is not part of this version.")
            continue
        found = plan.read(name)
        if found is None:
            yield from missing_cells(plan, [name], f"Figure 1, scene `{scene}`")
            continue
        yield from _scene(plan, scene, found)


def _scene(plan: Plan, scene: str, found: Measured) -> Iterator[Block]:
    moments, (large, small) = found.result["moments"], found.result["edges"]
    both = "camera" in found.result
    rows = ["the renderer of this package, in JAX", "MuJoCo's renderer"]
    shown = f"From top to bottom: {large}×{large} pixels by {rows[0]}" + (
        f" and by {rows[1]}, then {small}×{small} pixels, which the network sees, by both."
        if both
        else f", then {small}×{small} pixels, which the network sees."
    )
    alt = f"Images of the arm and the cube in the scene {scene}: {', '.join(moments)}"
    caption = f"Scene `{scene}`. {shown} The last two columns are moments of a scripted episode."
    yield stored(plan, f"{found.name}.png", alt, caption, wide=True)
    if not both:
        yield Text(f"MuJoCo's half is missing. {found.result['mujoco_missing']}.")
    else:
        yield Table(
            ("images", "median difference", "mean difference", "pixels that differ by over 16"),
            tuple(
                (
                    f"{edge}×{edge} pixels",
                    f"{values['median']:.0f} of 255",
                    f"{values['mean']:.1f} of 255",
                    percent(values["share_of_pixels_above_16"]),
                )
                for edge, values in ((large, found.result["camera"]),
                                     (small, found.result["network"]))
            ),
        )  # fmt: skip
        yield Text(
            "The difference is mostly at edges, which MuJoCo smooths. At network size both render "
            "without shadows, as the agents see it."
        )
    yield Source((found.file,))


def figure2(plan: Plan) -> Iterator[Block]:
    """The network: a diagram and its layers."""
    yield Heading("Figure 2: the network")
    names = _names(plan, "figure2")
    shown: list[Any] = []
    for name in names:
        found = plan.read(name)
        if found is None or found.result["layers"] in shown:
            continue
        shown.append(found.result["layers"])
        yield from _network(found)
    yield from missing_cells(plan, names, "Figure 2")
    if not names:
        yield Text("There is no agent whose network could be shown.")


def _network(found: Measured) -> Iterator[Block]:
    layers = found.result["layers"]
    names = "; ".join(layer["name"] for layer in layers)
    yield Picture(
        f"{found.name}.svg",
        draw_network(layers),
        f"Diagram of the network, from left to right: {names}",
        "The network of the agents, from the image to the Q-values of "
        f"{found.result['num_actions']} actions. The paper has three convolutions with max-pooling "
        "between them and two fully connected layers, and names no sizes: they are our choice.",
        wide=True,
    )
    rows = [
        (
            layer["name"],
            "×".join(map(str, layer["output"])),
            f"{layer['params']:,}",
            f"{layer['operations']:,}",
        )
        for layer in layers
    ]
    total = ("all", "", f"{found.result['params']:,}", f"{found.result['operations']:,}")
    head = ("layer", "shape of its output", "parameters", "multiply-adds for an image")
    yield Table(head, (*rows, total))
    yield Source((found.file,))


def figure3(plan: Plan) -> Iterator[Block]:
    """The curves of the trainings."""
    yield Heading("Figure 3: the trainings")
    for env in ("A", "B"):
        groups: dict[str, list[Measured]] = {}
        for subject in plan.subjects:
            found = plan.read(f"figure3-{subject.name}")
            if subject.trained_in == env and found is not None:
                groups.setdefault(subject.way, []).append(found)
        yield Heading(f"Environment {env}", 3)
        if groups:
            yield from _curves(env, groups)
        else:
            yield Text(f"There is no curve of a training in environment {env}.")
    yield from missing_cells(plan, _names(plan, "figure3"), "Figure 3")
    for subject in plan.subjects:
        if subject.run is None:
            yield Text(
                f"The curve of `{subject.name}` is not shown: its run folder is not here. Give it "
                "by `--runs`."
            )


def _curves(env: str, groups: dict[str, list[Measured]]) -> Iterator[Block]:
    curves = {way: [each.result for each in found] for way, found in groups.items()}
    yield Picture(
        f"figure3-{env}.svg",
        draw_figure3({WAYS[way]: found for way, found in curves.items()}),
        f"Curves of trainings in environment {env}: cumulative successes, mean reward and mean "
        "maximum Q-value, over episodes and over environment steps",
        "Thin lines are parts of the training, thick lines their smoothed mean; of several seeds "
        "the mean, with a band from the least to the largest. Rewards and Q-values are divided by "
        "the scale of the reward. Vertical lines: from here on success is regular.",
    )
    rows = []
    for way, seeds in groups.items():
        for each in seeds:
            regular, seed = each.result["regular"], each.name.rsplit("seed", 1)[-1]
            at = ("never", "never")
            if regular is not None:
                at = (f"{regular['episode']:,}", f"{regular['env_steps']:,}")
            rows.append((WAYS[way], seed, *at, f"{each.result['env_steps'][-1]:,}"))
    rows.append(("James & Johns 2016", "", f"{james_johns.REGULAR_EPISODE:,}", "not stated", ""))
    head = ("training", "seed", "regular from episode", "regular from step", "steps in all")
    yield Table(head, tuple(rows))
    yield Text(
        f"Success is regular from where half of {REGULAR_EPISODES} episodes in a row succeed. With "
        "a privileged teacher the teacher acts first, and the agent later in half of the "
        "environments: these curves are of the training, not of the agent alone."
    )
    yield Source(tuple(each.file for found in groups.values() for each in found))


def table1(plan: Plan) -> Iterator[Block]:
    """Success of each way of training, in both environments."""
    yield Heading("Table 1: success")
    rows, files = [], []
    for (trained, tried), successes in james_johns.SUCCESSES.items():
        rows.append(_paper_row(trained, tried, successes))
    for way in WAYS:
        for trained, tried in james_johns.SUCCESSES:
            found = _of_seeds(plan, way, trained, tried)
            if found:
                rows.append(_row(way, trained, tried, found))
                files += [each.file for _, each in found]
    head = (
        *("training", "trained in", "tried in", "episodes", "success", "95 % interval"),
        *("worst seed", "first 50 episodes of one seed", "held, not lifted"),
    )
    yield Table(head, tuple(rows))
    yield Text(
        "Share of episodes that end in success, one action in ten random (ε = 0.1). An episode "
        f"has at most {trial_of('A', plan.quick).max_steps:,} steps. The interval is over "
        "episodes (Wilson) where there is one seed, and over seeds (Student) where there are "
        "several. 'Held, not lifted' is the share of the episodes that grasped the cube at some "
        "time and failed. Each way of training has rows of "
        "its own; the rows are different experiments."
    )
    yield Source(tuple(files))
    yield from missing_cells(plan, _names(plan, "episodes"), "Table 1")
    for way in ("taught", "pixels"):
        here = {subject.trained_in for subject in plan.subjects if subject.way == way}
        if here != {"A", "B"}:
            section = "agents" if way == "taught" else "pixels"
            which = " and ".join(env for env in ("A", "B") if env not in here)
            yield Missing(
                f"Table 1, '{WAYS[way]}': no agent trained in {which}. This command trains and "
                "judges it; it says the hours first.",
                plan.command(section, "episodes"),
            )


def _of_seeds(plan: Plan, way: str, trained: str, tried: str) -> list[tuple[int, Measured]]:
    """The seeds of a way of training with the episodes of each."""
    found = []
    for subject in plan.subjects:
        if subject.key[:2] == (way, trained):
            each = plan.read(f"episodes-{subject.name}-in-{tried}")
            found += [] if each is None else [(subject.seed, each)]
    return found


def _paper_row(trained: str, tried: str, successes: int) -> tuple[str, ...]:
    count = james_johns.EPISODES
    bounds = interval(*wilson_interval(successes, count))
    rate = percent(successes / count)
    fifty = f"{successes} of {count}"
    return ("James & Johns 2016", trained, tried, str(count), rate, bounds, "–", fifty, "–")


def _row(way: str, trained: str, tried: str, found: list[tuple[int, Measured]]) -> tuple[str, ...]:
    results = [each.result for _, each in found]
    counts = [(x["successes"], x["episodes"]) for x in results]
    share = share_of(counts)
    assert share is not None
    worst = percent(min(s / n for s, n in counts)) if len(counts) > 1 else "one seed"
    held = sum(x["held_not_lifted"] for x in results) / sum(n for _, n in counts)
    seed, first = found[0][0], results[0]
    return (
        WAYS[way],
        trained,
        tried,
        f"{sum(n for _, n in counts):,}",
        percent(share.rate),
        f"{interval(share.low, share.high)}, {share.over}",
        worst,
        f"{first['first_successes']} of {first['first_episodes']}, seed {seed}",
        percent(held),
    )


def firsts(plan: Plan) -> Iterator[Subject]:
    """The first seed of each way of training in each environment."""
    seen = set()
    for subject in plan.subjects:
        if subject.agent is not None and subject.key[:2] not in seen:
            seen.add(subject.key[:2])
            yield subject


def figure4(plan: Plan) -> Iterator[Block]:
    """Q-values along one successful greedy episode."""
    yield Heading("Figure 4: Q-values along one episode")
    for subject in firsts(plan):
        found = plan.read(f"figure4-{subject.name}")
        if found is not None:
            yield Heading(f"{subject.name}, in environment {subject.trained_in}", 3)
            yield from _episode(plan, found)
    yield from missing_cells(plan, _names(plan, "figure4"), "Figure 4")


def _episode(plan: Plan, found: Measured) -> Iterator[Block]:
    result, episode = found.result, found.result["episode"]
    greedy = f"{result['successes']} of {result['episodes']} greedy episodes succeeded"
    if episode is None:
        yield Text(f"No curve: {greedy}.")
        yield Source((found.file,))
        return
    yield Picture(
        f"{found.name}-q.svg",
        draw_figure4(episode),
        f"Largest Q-value, distance and height over the {episode['length']} steps of an episode; "
        "the five frames below are marked",
        f"The successful greedy episode of median length: {episode['length']} steps; the paper's "
        f"has {james_johns.EPISODE_LENGTH}. {greedy}. Q-values are divided by the scale of the "
        "reward. The frames are chosen automatically: the start; half of the way to the cube; the "
        "gripper within 4 cm of its centre; the start of the last grasp; the end.",
    )
    marks = ", ".join(f"{mark['name']} at step {mark['frame']}" for mark in episode["marks"])
    yield stored(
        plan,
        f"{found.name}.png",
        f"Five frames of the episode: {marks}",
        "Above: the scene. Below: what the agent sees.",
        wide=True,
    )
    yield Source((found.file,))


_OPENS = {
    "on_the_table": "released a cube that was lifted by less than 1 cm",
    "caught": "grasped it again before it had fallen by 1 cm",
    "dropped": "dropped it",
}


def regrasping(plan: Plan) -> Iterator[Block]:
    """What random opens of the gripper do, and whether the agent grasps again."""
    yield Heading("Re-grasping")
    yield Text(
        "One action in ten is random, and one random action in fourteen opens the gripper. Counted "
        "are the random opens while the cube was grasped, where the agent itself preferred another "
        "action."
    )
    for subject in firsts(plan):
        found = plan.read(f"episodes-{subject.name}-in-{subject.trained_in}")
        if found is None:
            continue
        opens = found.result["opens"]
        yield Heading(f"{subject.name}, in environment {subject.trained_in}", 3)
        rows = [(words, *_of(opens[kind], opens["random_opens"])) for kind, words in _OPENS.items()]
        yield Table(
            ("a random open", "times", "share", "grasped again", "the episode succeeded"),
            tuple(rows),
        )
        yield Text(
            f"{opens['random_opens']:,} random opens in {found.result['episodes']:,} episodes. "
            f"{opens['episodes_with_drop']:,} episodes had at least one drop; "
            f"{opens['episodes_with_drop_succeeded']:,} of these succeeded."
        )
        for name in found.pictures:
            if name.endswith(".gif"):
                yield stored(
                    plan,
                    name,
                    "Animation: a random open drops the cube, the arm grasps it again and lifts it",
                    "A random open drops the cube; the agent grasps it again and finishes. The "
                    "shortest such episode, some frames left out.",
                )
        yield Source((found.file,))
    yield from missing_cells(plan, _own(plan), "Re-grasping")


def _of(row: dict[str, int], total: int) -> tuple[str, str, str, str]:
    count = row["count"]
    share = percent(count / total) if total else "–"
    if not count:
        return "0", share, "–", "–"
    again, succeeded = row["grasped_again"], row["succeeded"]
    return f"{count:,}", share, percent(again / count), percent(succeeded / count)


def _own(plan: Plan) -> list[str]:
    return [f"episodes-{x.name}-in-{x.trained_in}" for x in firsts(plan)]


def failures(plan: Plan) -> Iterator[Block]:
    """Failed episodes by cause, and success by the start."""
    yield Heading("Where it fails")
    subjects = [subject for subject in firsts(plan) if subject.trained_in == "B"]
    for subject in subjects:
        found = plan.read(f"episodes-{subject.name}-in-B")
        if found is not None:
            yield Heading(f"{subject.name}, in environment B", 3)
            yield from _failures(plan, found)
    names = [f"episodes-{subject.name}-in-B" for subject in subjects]
    yield from missing_cells(plan, names, "Where it fails")
    if not subjects:
        yield Text("There is no agent that was trained in B.")


def _failures(plan: Plan, found: Measured) -> Iterator[Block]:
    result = found.result
    episodes, failed = result["episodes"], result["episodes"] - result["successes"]
    yield Text(f"{failed:,} of {episodes:,} episodes failed.")
    rows = [
        (name.replace("_", " "), CAUSES[name], f"{count:,}", percent(count / episodes))
        for name, count in result["causes"].items()
    ]
    yield Table(("cause", "meaning", "episodes", "share of all"), tuple(rows))
    for cause in CAUSES:
        name = f"{found.name}-{cause}.png"
        if name in found.pictures:
            words = cause.replace("_", " ")
            yield stored(
                plan,
                name,
                f"Six frames of an episode that failed: {words}",
                f"The first episode that failed by '{words}'.",
                wide=True,
            )
    columns = result["episodes_each"]
    yield Picture(
        f"{found.name}-places.svg",
        draw_places(columns, result["rectangle"]),
        "Places of the cube at the start, seen from above, with successes and failures",
        "Success by the cube's place. The rectangle is where places are sampled.",
    )
    yield Picture(
        f"{found.name}-joints.svg",
        draw_joints(columns, result["noise_degrees"]),
        "Success by the start of each joint, in five bins with 95 % intervals",
        "Success by where each joint started. The dotted line is the mean of all episodes.",
    )
    yield Text(_where(columns))
    yield Source((found.file,))


def _where(columns: dict[str, Any]) -> str:
    """Success in each half of the cube's places, in words."""
    cubes = np.asarray(columns["cube"], float)
    success = np.asarray(columns["success"], bool)
    parts = []
    for axis, (low, high) in enumerate((("near", "far"), ("right", "left"))):
        middle = np.median(cubes[:, axis])
        rates = [success[cubes[:, axis] <= middle], success[cubes[:, axis] > middle]]
        words = [percent(float(x.mean())) if x.size else "–" for x in rates]
        parts.append(f"{words[0]} in the {low} half of the places, {words[1]} in the {high} half")
    return f"Success: {'; '.join(parts)}."
