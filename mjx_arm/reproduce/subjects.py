"""The agents that the page is about, and where they come from."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Iterable, Iterator, Sequence

from mjx_arm.config import TrainConfig, parse_config
from mjx_arm.envs.randomisation import Ranges
from mjx_arm.options import flat_names, get_option
from mjx_arm.training.agent import BEST, LAST, find_agent, read_agent, shipped_agents
from mjx_arm.training.run_folder import CONFIG, load_config, seed_configs, seed_folders

# How an agent was trained -> in words. Rows of a table never mix them.
WAYS = {
    "taught": "sees pixels alone, trained by a privileged teacher",
    "pixels": "sees pixels alone, no network ever saw the state",
    "state": "sees the simulator's state, no pixels",
    "taught-paper": "sees pixels alone, privileged teacher, published reward",
    "pixels-paper": "sees pixels alone, no network ever saw the state, published reward",
    "state-paper": "sees the simulator's state, published reward",
}
_SCENE = "arm_cube"
# Options in which seeds of one way may differ.
_FREE = frozenset({"seed", "num_seeds", "total_steps", "physics", "env", "eval_episodes"})


@dataclasses.dataclass(frozen=True)
class Subject:
    """An agent.

    Attributes:
      way: how it was trained, one of `WAYS`.
      trained_in: environment `A` or `B`.
      seed: of its training.
      config: options of its training.
      agent: what `load_agent` takes, or None where there is only a curve.
      run: a folder with the metrics of its training, or None.
    """

    way: str
    trained_in: str
    seed: int
    config: TrainConfig
    agent: str | None
    run: pathlib.Path | None

    @property
    def key(self) -> tuple[str, str, int]:
        """What no other agent of the page shares."""
        return self.way, self.trained_in, self.seed

    @property
    def name(self) -> str:
        """Its name in files: `taught-B-seed0`."""
        return f"{self.way}-{self.trained_in}-seed{self.seed}"


def way_of(config: TrainConfig) -> str | None:
    """How a configuration trains, one of `WAYS`; None where the page has no place for it.

    The page compares agents of one task in one scene, which nothing randomises.
    """
    env = config.env
    if env.task != "lift" or env.reward not in ("completion", "shaped", "paper"):
        return None
    if env.scene_name != _SCENE or env.randomise.ranges != Ranges():
        return None
    sees = "state" if env.observation == "state" else "pixels"
    base = "taught" if config.algorithm == "distill" else sees
    return f"{base}-paper" if env.reward == "paper" else base


def find_runs(folder: pathlib.Path) -> list[Subject]:
    """The agents of the run folders in a folder, or of the run folder that it is.

    Raises:
      ValueError: there is no run folder, or one is damaged.
    """
    if (folder / CONFIG).is_file():
        return list(_subjects_of(folder))
    if not folder.is_dir():
        raise ValueError(
            f"--runs {folder} is not a folder: give a run folder, or a folder of run folders"
        )
    runs = sorted(path.parent for path in folder.glob(f"*/{CONFIG}"))
    if not runs:
        raise ValueError(f"--runs {folder} holds no run folder: no folder in it has a {CONFIG}")
    return [subject for run in runs for subject in _subjects_of(run)]


def _subjects_of(run: pathlib.Path) -> Iterator[Subject]:
    config = load_config(run)
    way = way_of(config)
    if way is None:
        return
    for own, seed in zip(seed_folders(run, config), seed_configs(config), strict=True):
        agent = str(own) if any((own / name).is_file() for name in (BEST, LAST)) else None
        curve = own if (own / "metrics.jsonl").is_file() else None
        if agent is not None or curve is not None:
            yield Subject(way, config.env.env, seed.seed, seed, agent, curve)


def find_shipped() -> list[Subject]:
    """The agents of the task `lift` that come with the package."""
    found = []
    for name in shipped_agents():
        metadata = read_agent(find_agent(pathlib.Path(name)))[0]
        config = parse_config(metadata["config"], name)
        way = way_of(config)
        if way is not None:
            found.append(Subject(way, config.env.env, config.seed, config, name, None))
    return found


def merge(runs: Sequence[Subject], shipped: Sequence[Subject]) -> list[Subject]:
    """Agents from run folders, and from the package where the runs have only a curve or nothing.

    Raises:
      ValueError: two runs have the same environment, way of training and seed, or seeds of one way
        were trained with different options.
    """
    found: dict[tuple[str, str, int], Subject] = {}
    for subject in runs:
        if subject.key in found:
            raise ValueError(
                f"{found[subject.key].run} and {subject.run} are both {subject.name}: "
                "leave one of them out"
            )
        found[subject.key] = subject
    groups = {subject.key[:2] for subject in runs if subject.agent is not None}
    for subject in shipped:
        if subject.key[:2] in groups:
            continue
        curve = found.get(subject.key)
        if curve is not None:
            subject = dataclasses.replace(subject, run=curve.run)
        found[subject.key] = subject
    subjects = sorted(found.values(), key=lambda each: (list(WAYS).index(each.way), *each.key[1:]))
    _check_alike(subjects)
    return subjects


def _check_alike(subjects: Iterable[Subject]) -> None:
    firsts: dict[tuple[str, str], Subject] = {}
    for subject in subjects:
        first = firsts.setdefault(subject.key[:2], subject)
        for name in flat_names(first.config):
            if name in _FREE or name not in flat_names(subject.config):
                continue
            one, other = (get_option(x.config, name) for x in (first, subject))
            if one != other:
                raise ValueError(
                    f"{first.name} and {subject.name} were trained with different options, such as "
                    f"{name} = {one} and {other}: leave one of them out"
                )
