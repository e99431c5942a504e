"""Reads a command line: which command, and what it is given."""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
import typing
from collections.abc import Sequence
from typing import Annotated, Any, NoReturn, TypeVar

import jax
import tyro

from mjx_arm.arguments import read_arguments
from mjx_arm.cli.agent import Eval, Export, Play
from mjx_arm.cli.results import Agents, Compare, Figures, Reproduce, View
from mjx_arm.cli.standin import Deploy, Transfer
from mjx_arm.cli.train import PROCESSES, Sweep, Train
from mjx_arm.config import TrainConfig, set_train_options
from mjx_arm.devices import check_device
from mjx_arm.options import check_name, flat_annotations
from mjx_arm.presets import PRESETS
from mjx_arm.training.objects import ON_COMMAND_LINE, check_given_again
from mjx_arm.training.processes import join_processes
from mjx_arm.training.run_folder import parse_run, read_text

Command = (
    Train
    | Eval
    | Play
    | Figures
    | Compare
    | Agents
    | View
    | Sweep
    | Reproduce
    | Transfer
    | Deploy
    | Export
)
COMMANDS: dict[str, type[Command]] = {
    "train": Train,
    "eval": Eval,
    "play": Play,
    "figures": Figures,
    "compare": Compare,
    "agents": Agents,
    "view": View,
    "sweep": Sweep,
    "reproduce": Reproduce,
    "transfer": Transfer,
    "deploy": Deploy,
    "export": Export,
}
_SUBJECTS = {
    "agent": "an agent's file or a run folder",
    "folder": "a run folder",
    "runs": "run folders",
    "subject": "an agent, a run folder or a scene",
}


def default_preset() -> str:
    """`gpu` on an accelerator, `fast` on a CPU."""
    check_device()
    return "fast" if jax.default_backend() == "cpu" else "gpu"


Trains = TypeVar("Trains", Train, Sweep)


def _start(kind: type[Trains], arguments: Sequence[str]) -> tuple[Trains, dict[str, str]]:
    """What a command line starts from: its preset or file, and its task and algorithm by name.

    These two decide which options there are.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for name in ("preset", "config", "task", "algorithm", *ON_COMMAND_LINE):
        first.add_argument(f"--{name}", nargs="?")
    known = first.parse_known_args(arguments)[0]
    preset = known.preset or default_preset()
    check_name("preset", preset, PRESETS)
    options = PRESETS[preset]
    if known.config is not None:
        if known.preset is not None:
            raise ValueError("--preset and --config exclude each other: give one of them")
        saved = parse_run(read_text(pathlib.Path(known.config)), known.config)
        given = [name for name in ON_COMMAND_LINE if getattr(known, name) is not None]
        check_given_again(saved.objects, given, known.config)
        options = saved.config
    parts = {"task": known.task, "algorithm": known.algorithm}
    chosen = {name: value for name, value in parts.items() if value is not None}
    return kind(options=options, preset=preset), chosen


def parse(arguments: Sequence[str]) -> tuple[Command, frozenset[str]]:
    """The command of a command line, and the names of the options on it.

    Raises:
      ValueError: it is invalid.
    """
    if not arguments:
        raise ValueError(f"give a command: one of {', '.join(COMMANDS)}; see --help")
    if not {"-h", "--help"}.isdisjoint(arguments):
        _help(arguments)
    check_name("command", arguments[0], COMMANDS)
    kind = COMMANDS[arguments[0]]
    if kind is Train:
        return _parse_train(Train, arguments[1:])
    if kind is Sweep:
        return _parse_train(Sweep, arguments[1:])
    known = annotations_of(kind)
    if kind is Reproduce:
        values, others = read_arguments(arguments[1:], known)
        _check_none(others)
        return Reproduce(**values), frozenset(values)
    subject = next(iter(known))
    values, others = read_arguments(arguments[1:], known | {subject: pathlib.Path})
    return kind(**{**values, **_subject(kind, subject, arguments[0], others)}), frozenset(values)


def _subject(kind: type[Command], name: str, command: str, given: Sequence[str]) -> dict[str, Any]:
    """The argument of a command that has no `--`, by its name; empty where it may be left out."""
    if not given and kind is not Agents:
        raise ValueError(f"{command} needs {name.upper()}, {_SUBJECTS[name]}")
    if kind is Compare:
        return {name: tuple(pathlib.Path(text) for text in given)}
    _check_none(given[1:])
    if not given:
        return {}
    return {name: given[0] if kind is Agents else pathlib.Path(given[0])}


def _join(arguments: Sequence[str]) -> None:
    """Meets the other processes of the run, before anything asks jax for its devices."""
    known = {name: x for name, x in annotations_of(Train).items() if name in PROCESSES}
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for name in known:
        first.add_argument(f"--{name.replace('_', '-')}", nargs="?", const="")
    texts = vars(first.parse_known_args(arguments)[0])
    own = [f"--{name.replace('_', '-')}={text}" for name, text in texts.items() if text is not None]
    join_processes(**read_arguments(own, known)[0])


def _parse_train(kind: type[Trains], arguments: Sequence[str]) -> tuple[Trains, frozenset[str]]:
    if kind is Train:
        _join(arguments)
    start, chosen = _start(kind, arguments)
    own = {name: x for name, x in annotations_of(kind).items() if name != "options"}
    # Of the defaults, since the options of the start may fit the others on the command line alone.
    known = flat_annotations(set_train_options(TrainConfig(), _kinds_of(start.options) | chosen))
    values, others = read_arguments(arguments, own | known)
    _check_none(others)
    options = {name: value for name, value in values.items() if name not in own}
    rest = {name: value for name, value in values.items() if name in own}
    start = dataclasses.replace(start, **rest)
    return (
        dataclasses.replace(start, options=set_train_options(start.options, options)),
        frozenset(values),
    )


def _kinds_of(options: TrainConfig) -> dict[str, str]:
    return {"task": options.env.task, "algorithm": options.algorithm}


def _help_of(kind: type[Trains], arguments: Sequence[str]) -> Trains:
    """The command with the values that its help shows."""
    start, chosen = _start(kind, arguments)
    return dataclasses.replace(start, options=set_train_options(start.options, chosen))


def annotations_of(kind: type) -> dict[str, Any]:
    """The annotations of a command's fields, by their names."""
    return typing.get_type_hints(kind, include_extras=True)


def _check_none(others: Sequence[str]) -> None:
    if others:
        raise ValueError(f"unexpected argument {others[0]!r}: options start with --")


def _help(arguments: Sequence[str]) -> NoReturn:
    """Prints the help, which shows the values of the preset, and the options of the task."""
    train_ = Annotated[Train, tyro.conf.subcommand("train", default=_help_of(Train, arguments))]
    sweep_ = Annotated[Sweep, tyro.conf.subcommand("sweep", default=_help_of(Sweep, arguments))]
    commands: Any = (
        train_
        | Eval
        | Play
        | Figures
        | Compare
        | Agents
        | View
        | sweep_
        | Reproduce
        | Transfer
        | Deploy
        | Export
    )
    first = [name for name in arguments[:1] if name in COMMANDS]
    tyro.cli(
        commands,
        args=[*first, "--help"],
        prog="mjx-arm",
        config=(
            tyro.conf.OmitArgPrefixes,
            tyro.conf.OmitSubcommandPrefixes,
            tyro.conf.AvoidSubcommands,
        ),
    )
    raise AssertionError("tyro ends the process")
