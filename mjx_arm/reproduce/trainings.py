"""The trainings that the page needs: what each is, how long it takes, and running it."""

from __future__ import annotations

import dataclasses
import pathlib
from typing import Any

from rich.console import Console

from mjx_arm.config import DistillConfig, TrainConfig, set_train_options
from mjx_arm.presets import PRESETS
from mjx_arm.report.metrics import last_wall_s
from mjx_arm.training.run_folder import CONFIG, EVALUATION, load_config, seed_folders
from mjx_arm.training.runner import resume, train

# Environment steps per second on 2 cores, evaluations included, for the hours that are printed. By
# the metrics of `agent-a` (its teacher alone, then with its student) and by
# `benchmarks/results/time_to_success_2_cores.json`. The preset `paper` samples twice as much.
_TEACHER_ALONE, _TEACHER_AND_STUDENT, _PIXELS, _STATE = 6_000.0, 500.0, 1_700.0, 3_000.0
# Seconds to compile a training and its evaluations.
_COMPILING = 45.0


@dataclasses.dataclass(frozen=True)
class Training:
    """A run that the page needs.

    Attributes:
      name: of its run folder.
      config: options of the run.
      minutes: the run ends after this time; None for as many steps as the options say.
      episodes: of the evaluation at its end.
    """

    name: str
    config: TrainConfig
    minutes: float | None = None
    episodes: int = 1_000

    @property
    def hours(self) -> float:
        """About how long it takes on 2 cores."""
        seconds = _COMPILING + _seconds(self.config) * self.config.num_seeds
        if self.minutes is not None:
            seconds = min(seconds, _COMPILING + 60 * self.minutes)
        return seconds / 3600


def _seconds(config: TrainConfig) -> float:
    algo, steps = config.algo, config.total_steps
    if isinstance(algo, DistillConfig):
        alone = min(steps, algo.student_starts)
        return alone / _TEACHER_ALONE + (steps - alone) / _TEACHER_AND_STUDENT
    if config.env.observation == "state":
        return steps / _STATE
    return steps / _PIXELS * max(1.0, config.samples_per_step)


def is_same(training: Training, folder: pathlib.Path) -> bool:
    """Whether a folder holds a run, finished or not, with the options of a training."""
    if not (folder / CONFIG).is_file():
        return False
    saved = load_config(folder)
    # The backend of the physics is chosen by the machine.
    return saved == set_train_options(training.config, {"physics": saved.env.physics})


def is_finished(training: Training, folder: pathlib.Path) -> bool:
    """Whether a folder holds the whole run of a training, with the evaluation of each seed."""
    if not is_same(training, folder):
        return False
    seeds = seed_folders(folder, training.config)
    return all((seed / EVALUATION).is_file() for seed in seeds)


def run_training(training: Training, folder: pathlib.Path, console: Console) -> None:
    """Trains, or continues a run that was stopped; returns when it is finished.

    Raises:
      ValueError: the folder holds a run with other options, or cannot be used.
      RunInterruptedError: Ctrl-C or a signal; the same command continues.
    """
    if is_finished(training, folder):
        return
    console.print(f"training {training.name}: about {describe_hours(training.hours)}")
    options: dict[str, Any] = {
        "eval_episodes": training.episodes,
        "video": False,
        "console": console,
    }
    if not (folder / CONFIG).is_file():
        train(training.config, folder, minutes=training.minutes, **options)
        return
    _check_same(training, folder)
    minutes = training.minutes
    if minutes is not None:
        # A run that was stopped between its last chunk and its evaluation trains one more chunk.
        minutes = max(minutes, last_wall_s(folder) / 60)
    resume(folder, minutes=minutes, **options)


def _check_same(training: Training, folder: pathlib.Path) -> None:
    if not is_same(training, folder):
        raise ValueError(
            f"{folder} holds a run with other options than {training.name!r} has now: "
            "give --out another folder"
        )


def describe_hours(hours: float) -> str:
    """Hours in words."""
    if hours >= 1:
        return f"{hours:.1f} hours"
    minutes = max(1, round(60 * hours))
    return f"{minutes} minutes" if minutes > 1 else "1 minute"


# What the tiny trainings of `--quick` change.
_TINY = {
    "total_steps": 12_288,
    "chunk_steps": 4_096,
    "learning_starts": 1_000,
    "epsilon_steps": 8_000,
    "replay_size": 20_000,
    "select_every": 0,
    "select_episodes": 8,
    "max_steps": 100,
}
_TINY_TEACHER = {
    "teacher_batch_size": 64,
    "teacher_hidden": 64,
    "student_starts": 6_000,
    "student_updates_per_step": 1,
}
_QUICK_EPISODES = 8


def shorten(training: Training) -> Training:
    """A training that takes seconds, to prove the path."""
    config = training.config
    changes = dict(_TINY)
    if isinstance(config.algo, DistillConfig):
        changes |= _TINY_TEACHER
    elif config.algo.n_step == 1:
        changes |= {"target_period": 50}
    config = set_train_options(config, {**changes, "num_seeds": min(config.num_seeds, 2)})
    return Training(training.name, config, None, _QUICK_EPISODES)


# Name of a section of the page -> start of the names of its runs, and their preset.
AGENTS = {"agents": ("agent", "fast"), "pixels": ("pixels", "pixels")}


def agent_trainings(section: str, seeds: int = 1) -> list[Training]:
    """Agents A and B by the default preset (`agents`), or without a teacher (`pixels`).

    Args:
      section: a key of `AGENTS`.
      seeds: of each, from 0 on.
    """
    start, preset = AGENTS[section]
    return [
        _training(f"{start}-{env}-seed{seed}", PRESETS[preset], env=env, seed=seed)
        for env in ("A", "B")
        for seed in range(seeds)
    ]


# Name -> options that differ from the preset, and what the row says.
REWARDS: dict[str, tuple[dict[str, object], str]] = {
    "completion": ({}, "`completion`, γ = 0.99: success is worth more than waiting"),
    "shaped": ({"reward": "shaped"}, "`shaped`, γ = 0.99: `completion`, paid once it is earned"),
    "published": ({"reward": "paper"}, "published, γ = 0.99: hovering is worth more than success"),
    "published-98": (
        {"reward": "paper", "gamma": 0.98},
        "published, γ = 0.98: success is worth more than hovering",
    ),
}
REWARD_SEEDS = 2


def reward_trainings() -> list[Training]:
    """The default preset in A on each reward: the same steps and the same seeds."""
    budget = {"total_steps": 1_500_000, "student_starts": 700_000, "env": "A"}
    return [
        _training(f"reward-{name}-seed{seed}", PRESETS["fast"], **budget, **changes, seed=seed)
        for name, (changes, _) in REWARDS.items()
        for seed in range(REWARD_SEEDS)
    ]


def paper_training() -> Training:
    """The preset `paper` in A until its schedule of epsilon ends."""
    return _training("paper-A", PRESETS["paper"], env="A", total_steps=1_000_000)


@dataclasses.dataclass(frozen=True)
class Ablation:
    """A change to the default preset.

    Attributes:
      name: in files.
      title: what is changed.
      changes: options; None where no option of this version makes the change.
    """

    name: str
    title: str
    changes: dict[str, object] | None


ABLATIONS = (
    Ablation("teacher", "no teacher: the pixel network learns by Q-learning itself", {
        "algorithm": "dqn", "n_step": 5,
    }),
    Ablation("double", "no double Q-learning", {"teacher_double": False}),
    Ablation("dueling", "no value and advantage streams, in both networks", {
        "dueling": False, "teacher_dueling": False,
    }),
    Ablation("n-step", "returns of 1 step instead of 5", {"n_step": 1}),
    Ablation("loss", "squared error instead of Huber's", {"teacher_huber": False}),
    Ablation("distributional", "a distributional head", None),
    Ablation("replay", "a replay of 100,000 instead of 1,000,000", {"replay_size": 100_000}),
    Ablation("samples", "1 sample a step for the teacher instead of 8", {"teacher_batch_size": 64}),
    Ablation("epsilon", "1 % random actions at the end instead of 10 %", {"epsilon_end": 0.01}),
    Ablation("held", "random actions that are held for several steps", None),
    Ablation("gamma", "γ = 0.98 instead of 0.99", {"gamma": 0.98}),
    Ablation("size", "images of 32×32 pixels instead of 64×64", {"size": (32, 32)}),
    Ablation("environments", "16 environments instead of 64, batches in proportion", {
        "num_envs": 16, "teacher_batch_size": 128, "student_batch_size": 48,
        "student_updates_per_step": 1,
    }),
    Ablation("normalisation", "no LayerNorm, in both networks", {
        "layer_norm": False, "teacher_layer_norm": False,
    }),
)  # fmt: skip
DEFAULT = "default"
# Minutes of each; with 12 variants and the default in A, and the default and three in B, 2.6 hours.
ABLATION_MINUTES = 9.0
# Variants that are tried again in B.
STRONGEST = 3


def ablation_training(name: str, env: str) -> Training:
    """The default preset with one change, for the same minutes as the others."""
    changes: dict[str, object] = {}
    for ablation in ABLATIONS:
        if ablation.name == name:
            assert ablation.changes is not None
            changes = ablation.changes
    training = _training(f"ablation-{env}-{name}", PRESETS["fast"], env=env, **changes)
    return dataclasses.replace(training, minutes=ABLATION_MINUTES)


def _training(name: str, preset: TrainConfig, **changes: object) -> Training:
    return Training(name, set_train_options(preset, changes))
