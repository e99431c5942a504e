"""What is on the page: its agents, its cells, and the trainings that they need."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import pathlib
import shlex
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from mjx_arm.config import dump_config
from mjx_arm.options import Count, check_name, check_value
from mjx_arm.reproduce.curves import read_curve
from mjx_arm.reproduce.scenes import SCENES, measure_scene
from mjx_arm.reproduce.store import RUNS, Measured, Store
from mjx_arm.reproduce.studies import measure_ablation, measure_paper, measure_reward
from mjx_arm.reproduce.subjects import Subject, find_runs, find_shipped, merge, way_of
from mjx_arm.reproduce.trainings import (
    ABLATIONS,
    AGENTS,
    DEFAULT,
    STRONGEST,
    Training,
    ablation_training,
    agent_trainings,
    is_finished,
    is_same,
    paper_training,
    reward_trainings,
    shorten,
)
from mjx_arm.reproduce.trials import (
    Result,
    Trial,
    measure_episodes,
    measure_greedy,
    measure_network,
    trial_inputs,
)
from mjx_arm.scene import read_source, scene_exists
from mjx_arm.training.agent import BEST, LAST
from mjx_arm.training.run_folder import CONFIG

# Parts of the page. Those in `_BY_DEFAULT` are made by default, the others must be asked for.
SECTIONS = {
    "agents": "agents A and B by the default preset",
    "figure1": "the scenes",
    "figure2": "the network",
    "figure3": "the curves of the trainings",
    "episodes": "Table 1, re-grasping and where it fails",
    "figure4": "Q-values along one episode",
    "pixels": "agents A and B without a teacher",
    "reward": "the study of the reward",
    "paper": "the preset paper in A",
    "ablations": "what matters, in A",
    "ablations-B": "the strongest of them in B",
    "page": "nothing is measured, the page alone is written again",
}
_BY_DEFAULT = ("agents", "figure1", "figure2", "figure3", "episodes", "figure4")
# Of the ablations, those that `--quick` tries.
_QUICK_ABLATIONS = (DEFAULT, "n-step", "size")
_ENVS = ("A", "B")


@dataclasses.dataclass(frozen=True)
class Cell:
    """A part of the page that is measured on its own, and has a file of its own.

    Attributes:
      name: of the file.
      section: one of `SECTIONS`.
      measure: returns the figures and the pictures.
      inputs: returns what is measured, and how, as a JSON object; raises ValueError if the agent or
        the run is not there.
      training: the run that it needs, or None.
    """

    name: str
    section: str
    measure: Callable[[], Result]
    inputs: Callable[[], dict[str, Any]]
    training: Training | None = None


def read_cell(store: Store, cell: Cell) -> Measured | None:
    """The file of a cell; None if there is none of the cell's own inputs.

    Raises:
      ValueError: the file is damaged.
    """
    found = store.read(cell.name)
    if found is None:
        return None
    try:
        wanted = json.loads(json.dumps(cell.inputs()))
    except ValueError:
        return None
    return found if found.inputs == wanted else None


@dataclasses.dataclass(frozen=True)
class Plan:
    """What is on the page.

    Attributes:
      store: its folder.
      quick: tiny trainings and few episodes.
      options: of the command, without those that choose cells.
      subjects: its agents.
      cells: in the order of the page.
      trainings: all trainings that it may need.
      chosen: names of the sections and cells to measure.
    """

    store: Store
    quick: bool
    options: tuple[str, ...]
    subjects: tuple[Subject, ...]
    cells: tuple[Cell, ...]
    trainings: tuple[Training, ...]
    chosen: frozenset[str]

    def run_folder(self, training: Training) -> pathlib.Path:
        """Where a training of the page is."""
        return self.store.folder / RUNS / training.name

    def command(self, *names: str) -> str:
        """The command that fills sections or cells, or the whole page if none is named."""
        only = ["--only", *names] if names else []
        return shlex.join(["mjx-arm", "reproduce", *only, *self.options])

    def is_chosen(self, name: str, section: str) -> bool:
        """Whether a cell or a training is to be made now."""
        return name in self.chosen or section in self.chosen

    def read(self, name: str) -> Measured | None:
        """The file of a cell; None if there is none of the agent and the options of this plan.

        Raises:
          ValueError: the file is damaged.
        """
        return next((read_cell(self.store, cell) for cell in self.cells if cell.name == name), None)

    def wanted_trainings(self) -> list[Training]:
        """The trainings that the chosen cells need and that are not finished."""
        wanted = {
            cell.training.name
            for cell in self.cells
            if cell.training is not None
            and self.is_chosen(cell.name, cell.section)
            and self.read(cell.name) is None
        }
        for section, trainings in self._agent_trainings():
            if section in self.chosen:
                wanted |= {training.name for training in trainings}
        return [
            training
            for training in self.trainings
            if training.name in wanted and not is_finished(training, self.run_folder(training))
        ]

    def _agent_trainings(self) -> Iterator[tuple[str, list[Training]]]:
        for section, (start, _) in AGENTS.items():
            yield section, [x for x in self.trainings if x.name.startswith(f"{start}-")]


def make_plan(
    out: pathlib.Path,
    *,
    runs: pathlib.Path | None,
    shipped: bool,
    quick: bool,
    only: Sequence[str],
    seeds: int = 1,
) -> Plan:
    """Plans the page.

    Args:
      out: its folder.
      runs: a folder of run folders, or a run folder, whose agents are shown.
      shipped: show the agents that come with the package where the runs have none.
      quick: tiny trainings and few episodes, to prove the path.
      only: sections or cells to measure; empty for those that are made by default.
      seeds: number of seeds of each agent that is trained.

    Raises:
      ValueError: a name in `only` is unknown, or there is no run folder.
    """
    check_value("seeds", Count, seeds)
    store = Store(out)
    options = _options(out, runs=runs, shipped=shipped, quick=quick, seeds=seeds)
    made_here = [each for section in AGENTS for each in agent_trainings(section, seeds)]
    made_here = _adapt(made_here, quick)
    trains = runs is None and not shipped
    subjects = merge(
        [] if runs is None else find_runs(runs),
        find_shipped() if shipped else [],
    )
    subjects = _with_own(subjects, store, made_here, trains)
    trainings = [*made_here, *_study_trainings(store, quick)]
    cells = [*_agent_cells(subjects, quick), *_study_cells(store, trainings, quick)]
    names = [*SECTIONS, *(cell.name for cell in cells)]
    for name in only:
        check_name("section or cell", name, names)
    chosen = set(only)
    if not only:
        chosen = set(_BY_DEFAULT) - (set() if trains else {"agents"})
        if quick and trains:
            chosen |= {"reward", "paper", *(f"ablation-A-{name}" for name in _QUICK_ABLATIONS)}
    return Plan(
        store, quick, options, tuple(subjects), tuple(cells), tuple(trainings), frozenset(chosen)
    )


def _adapt(trainings: Sequence[Training], quick: bool) -> list[Training]:
    return [shorten(training) for training in trainings] if quick else list(trainings)


def _options(
    out: pathlib.Path, *, runs: pathlib.Path | None, shipped: bool, quick: bool, seeds: int
) -> tuple[str, ...]:
    words = [] if runs is None else ["--runs", str(runs)]
    words += ["--shipped"] if shipped else []
    words += ["--quick"] if quick else []
    words += ["--seeds", str(seeds)] if seeds > 1 else []
    return (*words, "--out", str(out))


def _with_own(
    subjects: Sequence[Subject], store: Store, trainings: Sequence[Training], trains: bool
) -> list[Subject]:
    """The agents, and those that are trained for the page, also before they are trained."""
    found = {subject.key[:2] for subject in subjects}
    own = []
    for training in trainings:
        way, env = way_of(training.config), training.config.env.env
        assert way is not None
        folder = store.folder / RUNS / training.name
        there = any((folder / name).is_file() for name in (BEST, LAST))
        if (way, env) in found or not (there or (trains and training.name.startswith("agent-"))):
            continue
        # Another run is there, such as one of `--quick`: its agent is not the one that is shown.
        if (folder / CONFIG).is_file() and not is_same(training, folder):
            continue
        own.append(Subject(way, env, training.config.seed, training.config, str(folder), folder))
    return [*subjects, *own]


def trial_of(env: str, quick: bool, **changes: Any) -> Trial:
    """How agents are tried in an environment: 1,000 episodes, or few short ones if `quick`."""
    trial = Trial(env, 40 if quick else 1_000, max_steps=300 if quick else 1_000)
    return dataclasses.replace(trial, **changes)


def _agent_cells(subjects: Sequence[Subject], quick: bool) -> Iterator[Cell]:
    for scene in SCENES:
        if scene_exists(scene):
            yield _scene_cell(scene)
    for subject in subjects:
        if subject.agent is not None and subject.seed == _first_seed(subjects, subject):
            yield _network_cell(subject)
    for subject in subjects:
        if subject.run is not None:
            yield _curve_cell(subject)
    for subject in subjects:
        if subject.agent is not None:
            for env in _ENVS:
                yield _episodes_cell(subject, env, quick)
    for subject in subjects:
        if subject.agent is not None and subject.seed == _first_seed(subjects, subject):
            yield _greedy_cell(subject, quick)


def _first_seed(subjects: Sequence[Subject], subject: Subject) -> int:
    return min(x.seed for x in subjects if x.key[:2] == subject.key[:2] and x.agent is not None)


def _scene_cell(scene: str) -> Cell:
    return Cell(
        f"figure1-{scene}",
        "figure1",
        lambda: measure_scene(scene),
        lambda: {"scene_sha256": read_source(scene).digest},
    )


def _network_cell(subject: Subject) -> Cell:
    agent = str(subject.agent)
    return Cell(
        f"figure2-{subject.name}",
        "figure2",
        lambda: measure_network(agent),
        lambda: trial_inputs(agent, Trial(subject.trained_in, 1)),
    )


def _curve_cell(subject: Subject) -> Cell:
    run, scale = subject.run, subject.config.env.reward_scale
    assert run is not None
    return Cell(
        f"figure3-{subject.name}",
        "figure3",
        lambda: (read_curve(run, scale), {}),
        lambda: {"metrics_sha256": _digest(run / "metrics.jsonl"), "reward_scale": scale},
    )


def _episodes_cell(subject: Subject, env: str, quick: bool) -> Cell:
    agent, trial = str(subject.agent), trial_of(env, quick)
    name = f"episodes-{subject.name}-in-{env}"
    return Cell(
        name,
        "episodes",
        lambda: measure_episodes(name, agent, trial, pictures=env == subject.trained_in),
        lambda: trial_inputs(agent, trial),
    )


def _greedy_cell(subject: Subject, quick: bool) -> Cell:
    episodes = 40 if quick else 200
    agent, name = str(subject.agent), f"figure4-{subject.name}"
    trial = trial_of(subject.trained_in, quick, episodes=episodes, epsilon=0.0)
    return Cell(
        name,
        "figure4",
        lambda: measure_greedy(name, agent, trial),
        lambda: trial_inputs(agent, trial),
    )


def _study_trainings(store: Store, quick: bool) -> list[Training]:
    rewards = reward_trainings()
    if quick:
        rewards = [each for each in rewards if each.config.seed == 0]
    names = [DEFAULT, *(each.name for each in ABLATIONS if each.changes is not None)]
    in_a = _adapt([ablation_training(name, "A") for name in names], quick)
    strongest = strongest_ablations(store, _study_cells(store, in_a, quick))
    in_b = [ablation_training(name, "B") for name in (DEFAULT, *strongest)] if strongest else []
    return [*_adapt([*rewards, paper_training()], quick), *in_a, *_adapt(in_b, quick)]


def strongest_ablations(store: Store, cells: Iterable[Cell]) -> list[str]:
    """Names of the three changes with the largest effect in A; empty before all are measured.

    Args:
      store: of the page.
      cells: of a plan; files of other options do not count.
    """
    found = {
        cell.name.removeprefix("ablation-A-"): read_cell(store, cell)
        for cell in cells
        if cell.section == "ablations"
    }
    rates = {name: each.result["rate"] for name, each in found.items() if each is not None}
    if not found or len(rates) < len(found):
        return []
    default = rates.pop(DEFAULT)
    return sorted(rates, key=lambda name: (-abs(rates[name] - default), name))[:STRONGEST]


def _study_cells(store: Store, trainings: Sequence[Training], quick: bool) -> Iterator[Cell]:
    for training in trainings:
        run = store.folder / RUNS / training.name
        kind, _, _ = training.name.partition("-")
        if kind == "reward":
            yield _reward_cell(training, run, quick)
        elif kind == "paper":
            yield _paper_cell(training, run, quick)
        elif kind == "ablation":
            yield _ablation_cell(training, run)


def _reward_cell(training: Training, run: pathlib.Path, quick: bool) -> Cell:
    trial = trial_of("A", quick, episodes=40 if quick else 400)
    name = training.name
    return Cell(
        name,
        "reward",
        lambda: measure_reward(name, run, trial),
        lambda: {
            "config": dump_config(training.config),
            "agent": LAST,
            **dataclasses.asdict(trial),
        },
        training,
    )


def _paper_cell(training: Training, run: pathlib.Path, quick: bool) -> Cell:
    trials = {"epsilon 0.1": trial_of("A", quick), "greedy": trial_of("A", quick, epsilon=0.0)}
    name = training.name
    return Cell(
        name,
        "paper",
        lambda: measure_paper(name, run, trials),
        lambda: {
            "config": dump_config(training.config),
            "agent": LAST,
            "trials": {label: dataclasses.asdict(trial) for label, trial in trials.items()},
        },
        training,
    )


def _ablation_cell(training: Training, run: pathlib.Path) -> Cell:
    section = "ablations-B" if training.config.env.env == "B" else "ablations"
    return Cell(
        training.name,
        section,
        lambda: measure_ablation(run),
        lambda: {
            "config": dump_config(training.config),
            "minutes": training.minutes,
            "episodes": training.episodes,
        },
        training,
    )


def _digest(path: pathlib.Path) -> str:
    if not path.is_file():
        raise ValueError(f"{path} is not there")
    return hashlib.sha256(path.read_bytes()).hexdigest()
