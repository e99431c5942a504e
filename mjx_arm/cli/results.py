"""The commands that show what there is: runs, agents, scenes, and the paper on one page."""

from __future__ import annotations

import dataclasses
import json
import pathlib
import sys

import tyro

from mjx_arm.devices import check_device
from mjx_arm.envs.tasks import find_task
from mjx_arm.report.figures import plot_curves
from mjx_arm.report.progress import make_console
from mjx_arm.report.run_page import write_report
from mjx_arm.reproduce.command import reproduce
from mjx_arm.tools.compare import describe, read_results, to_json, write_comparison
from mjx_arm.tools.zoo import describe_zoo, read_shipped, read_zoo
from mjx_arm.training.run_folder import load_config, seed_folders
from mjx_arm.view.viewer import ViewOptions, view


@dataclasses.dataclass(frozen=True)
class Figures:
    """Draw the curves of a run again, and write its report, also while it trains.

    Attributes:
      folder: a run folder.
    """

    folder: tyro.conf.Positional[pathlib.Path]

    def run(self, given: frozenset[str]) -> None:
        """Runs the command."""
        del given
        config = load_config(self.folder)
        seeds = seed_folders(self.folder, config)
        units = find_task(config.env.task).units
        for path in plot_curves(seeds, into=self.folder, units=units):
            print(path)
        print(write_report(self.folder, config, seeds))


@dataclasses.dataclass(frozen=True)
class Compare:
    """Put runs side by side: success with 95 % intervals, time to a success rate, options.

    Attributes:
      runs: run folders; the others are compared with the first.
      out: a page to write, ending in `.html`, with the curves of all runs in one picture.
      json: print one JSON array.
    """

    runs: tyro.conf.Positional[tuple[pathlib.Path, ...]]
    out: pathlib.Path | None = None
    json: bool = False

    def run(self, given: frozenset[str]) -> None:
        """Runs the command."""
        del given
        results = read_results(self.runs)
        print(json.dumps(to_json(results)) if self.json else describe(results))
        if self.out is not None:
            write_comparison(results, self.out)
            print(self.out, file=sys.stderr if self.json else sys.stdout)


@dataclasses.dataclass(frozen=True)
class Agents:
    """List the agents that come with the package, or show the card of one.

    Attributes:
      agent: name of an agent whose card to show.
      json: print JSON: an array of all agents, or one object.
    """

    agent: tyro.conf.Positional[str | None] = None
    json: bool = False

    def run(self, given: frozenset[str]) -> None:
        """Runs the command."""
        del given
        if self.agent is not None:
            agent = read_shipped(self.agent)
            print(json.dumps(agent.to_json()) if self.json else agent.card.rstrip())
            return
        agents = read_zoo()
        if self.json:
            print(json.dumps([agent.to_json() for agent in agents]))
            return
        print(describe_zoo(agents))
        print(
            "\nSuccess: share of held-out episodes with one random action in ten."
            "\nmjx-arm agents NAME shows its card; mjx-arm play NAME records a video."
        )


@dataclasses.dataclass(frozen=True)
class View(ViewOptions):
    """Watch an agent in the browser: its Q-values, what it sees; step, push the cube by hand.

    An agent of a run that still trains is loaded again as often as the run saves it.

    Attributes:
      subject: an agent, a run folder, or the name or path of a scene.
    """

    subject: tyro.conf.Positional[pathlib.Path]

    def run(self, given: frozenset[str]) -> None:
        """Runs the command."""
        del given
        check_device()
        view(self)


@dataclasses.dataclass(frozen=True)
class Reproduce:
    """Make one page with the tables and figures of James & Johns 2016, measured again.

    Every figure is measured into a file of its own in the folder. A figure that has its file is not
    measured again, so a command that was stopped continues when it is run again. Without `--runs`
    and `--shipped` agents A and B are trained first, which takes hours; the number is printed
    before. The long studies are trained only when `--only` names them.

    Attributes:
      out: folder of the page.
      runs: a folder of run folders, or a run folder, whose agents are shown.
      shipped: show the agents that come with the package where the runs have none.
      seeds: of each agent that is trained.
      quick: tiny trainings and few episodes, to prove in minutes that everything works.
      only: parts to measure: `agents`, `figure1`, `figure2`, `figure3`, `episodes`, `figure4`,
        `pixels`, `reward`, `paper`, `ablations`, `ablations-B`, `page` (the page alone), or the
        name of a file in `cells/`.
    """

    out: pathlib.Path = pathlib.Path("runs/reproduction")
    runs: pathlib.Path | None = None
    shipped: bool = False
    seeds: int = 1
    quick: bool = False
    only: tuple[str, ...] = ()

    def run(self, given: frozenset[str]) -> None:
        """Runs the command."""
        del given
        check_device()
        reproduce(
            self.out,
            runs=self.runs,
            shipped=self.shipped,
            quick=self.quick,
            only=self.only,
            seeds=self.seeds,
            console=make_console(),
        )
