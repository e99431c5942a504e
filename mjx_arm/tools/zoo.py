"""The agents that come with the package: what each is, and its card."""

from __future__ import annotations

import dataclasses
import json
import pathlib
import re
from collections.abc import Sequence
from typing import Any

from mjx_arm.config import TrainConfig, parse_config
from mjx_arm.options import check_name
from mjx_arm.training.agent import find_agent, read_agent, read_card, shipped_agents
from mjx_arm.training.evaluate import wilson_interval

# A row of the table in a card: `| success in B | 987 of 1,000 held-out episodes ...`.
_SUCCESS = re.compile(r"^\| success in (\w+) \| ([\d,]+) of ([\d,]+)\b", re.MULTILINE)


@dataclasses.dataclass(frozen=True)
class ShippedAgent:
    """An agent that comes with the package.

    Attributes:
      name: what `load_agent` and the command line call it.
      config: options of its training.
      env_steps: environment steps that it was trained for.
      selection_rate: share of successes in the evaluation that selected it, or None.
      results: successes and episodes in each environment in which its card has them, by the
        environment's name.
      card: how it was trained, how it does and where it fails, in Markdown.
    """

    name: str
    config: TrainConfig
    env_steps: int
    selection_rate: float | None
    results: dict[str, tuple[int, int]]
    card: str

    @property
    def sees(self) -> str:
        """What the agent sees, in words."""
        env = self.config.env
        if env.observation == "state":
            return "the simulator's state"
        height, width = env.size
        return f"{height}×{width} pixels of {' and '.join(env.cameras)}"

    @property
    def success(self) -> str:
        """Its success rates in words, with what was counted."""
        if self.results:
            rates = (
                f"{100 * successes / episodes:.1f} % of {episodes:,} in {env}"
                for env, (successes, episodes) in self.results.items()
            )
            return ", ".join(rates)
        if self.selection_rate is not None:
            episodes = self.config.select_episodes
            return f"{100 * self.selection_rate:.0f} % of the {episodes} that selected it"
        return "not evaluated"

    def to_json(self) -> dict[str, Any]:
        """The agent's figures as a JSON object, without its card."""
        return {
            "name": self.name,
            "task": self.config.env.task,
            "env": self.config.env.env,
            "algorithm": self.config.algorithm,
            "sees": self.sees,
            "env_steps": self.env_steps,
            "selection_rate": self.selection_rate,
            "results": {
                env: {
                    "episodes": episodes,
                    "successes": successes,
                    "rate": successes / episodes,
                    "ci95": wilson_interval(successes, episodes),
                }
                for env, (successes, episodes) in self.results.items()
            },
        }


def read_shipped(name: str) -> ShippedAgent:
    """Reads a shipped agent's figures and card, without making its environment.

    Raises:
      ValueError: no shipped agent has this name, or its file is damaged.
    """
    check_name("agent", name, shipped_agents())
    path = find_agent(pathlib.Path(name))
    metadata = read_agent(path)[0]
    card = read_card(path, metadata)
    return ShippedAgent(
        name=name,
        config=parse_config(metadata["config"], str(path)),
        env_steps=json.loads(metadata["env_steps"]),
        selection_rate=json.loads(metadata["selection_rate"]),
        results=card_results(card),
        card=card,
    )


def card_results(card: str) -> dict[str, tuple[int, int]]:
    """The rows `success in ENV` of a card: successes and episodes by the environment's name."""
    return {
        env: (_whole_number(successes), _whole_number(episodes))
        for env, successes, episodes in _SUCCESS.findall(card)
    }


def _whole_number(text: str) -> int:
    """A number with commas between its thousands."""
    return int(text.replace(",", ""))


def read_zoo() -> list[ShippedAgent]:
    """All agents that come with the package, by name."""
    return [read_shipped(name) for name in shipped_agents()]


def describe_zoo(agents: Sequence[ShippedAgent]) -> str:
    """A table of agents as lines of text."""
    head = ("name", "task", "env", "sees", "trained by", "steps", "success")
    rows = [
        (
            agent.name,
            agent.config.env.task,
            agent.config.env.env,
            agent.sees,
            agent.config.algorithm,
            f"{agent.env_steps:,}",
            agent.success,
        )
        for agent in agents
    ]
    return text_table([head, *rows])


def text_table(rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells as aligned lines of text, without trailing spaces."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        for row in rows
    ]
    return "\n".join(line.rstrip() for line in lines)
