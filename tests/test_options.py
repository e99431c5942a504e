from __future__ import annotations

import dataclasses
import json
import math
from typing import Annotated, Literal

import numpy as np
import pytest
from pydantic import Field

from mjx_arm import presets
from mjx_arm.config import (
    TrainConfig,
    advice,
    dump_config,
    parse_config,
    set_train_options,
    train_config,
)
from mjx_arm.envs.config import EnvConfig, set_env_options
from mjx_arm.envs.tasks import task_names
from mjx_arm.options import (
    Count,
    CountOrZero,
    Discount,
    NotNegative,
    Positive,
    Share,
    Size,
    flat_names,
    get_option,
    option_names,
    options,
    set_options,
)
from mjx_arm.presets import PRESETS


@options
class Every:
    """One option of each kind.

    Attributes:
      count: .
    """

    count: Count = 1
    count_or_zero: CountOrZero = 0
    positive: Positive = 1.0
    not_negative: NotNegative = 0.0
    share: Share = 0.5
    discount: Discount = 0.9
    size: Size = (2, 3)
    names: tuple[str, ...] = ("a",)
    flag: bool = False
    text: str = ""
    number: float = 0.0
    kind: Literal["a", "b"] = "a"
    maybe: float | None = None
    name_or_names: str | tuple[str, ...] = "a"
    above: Annotated[float, Field(gt=1, le=3)] = 2.0
    between: Annotated[int, Field(ge=2, le=5)] = 2


INVALID = [
    ("count", 0, "a whole number of at least 1"),
    ("count", 2.0, "a whole number of at least 1"),
    ("count", 2.5, "a whole number of at least 1"),
    ("count", True, "a whole number of at least 1"),
    ("count", "3", "a whole number of at least 1"),
    ("count", None, "a whole number of at least 1"),
    ("count", 2**31, "a whole number of at least 1 and at most 2147483647"),
    ("count_or_zero", -1, "a whole number of at least 0"),
    ("positive", 0.0, "a finite number above 0"),
    ("positive", math.inf, "a finite number above 0"),
    ("positive", math.nan, "a finite number above 0"),
    ("positive", True, "a finite number above 0"),
    ("positive", "1.0", "a finite number above 0"),
    ("not_negative", -0.1, "a finite number of at least 0"),
    ("share", 1.1, "a finite number from 0 to 1"),
    ("discount", 0.0, "a finite number above 0 and of at most 1"),
    ("size", (2,), "a tuple of two values, each a whole number of at least 1"),
    ("size", (2, 3, 4), "a tuple of two values, each a whole number of at least 1"),
    ("size", (2, 0), "a tuple of two values, each a whole number of at least 1"),
    ("size", 64, "a tuple of two values, each a whole number of at least 1"),
    ("names", "ab", "a tuple, each item text"),
    ("names", (1,), "a tuple, each item text"),
    ("flag", 1, "true or false"),
    ("flag", "yes", "true or false"),
    ("text", 1, "text"),
    ("number", -math.inf, "a finite number"),
    ("number", [1.0], "a finite number"),
    ("kind", "c", "one of a, b"),
    ("kind", None, "one of a, b"),
    ("maybe", math.nan, "a finite number or None"),
    ("name_or_names", 3, "text or a tuple, each item text"),
    ("above", 1.0, "a finite number above 1 and of at most 3"),
    ("between", 6, "a whole number from 2 to 5"),
]


@pytest.mark.parametrize(("name", "value", "allowed"), INVALID)
def test_an_invalid_value_gets_one_sentence(name, value, allowed):
    expected = f"{name} must be {allowed}, got {value!r}"
    for make in (lambda: Every(**{name: value}), lambda: set_options(Every(), {name: value})):
        # Lists count as tuples there, so that JSON can be read.
        expected_value = tuple(value) if isinstance(value, list) else value
        with pytest.raises(ValueError, match="must be") as raised:
            make()
        said = str(raised.value)
        assert said in (expected, f"{name} must be {allowed}, got {expected_value!r}")


def test_a_long_value_is_cut():
    with pytest.raises(ValueError, match="got") as raised:
        Every(count="x" * 1000)
    assert len(str(raised.value)) < 150


@pytest.mark.parametrize(
    ("name", "value"),
    [("positive", 3), ("number", 1), ("maybe", None), ("size", (1, 1)), ("name_or_names", ("a",))],
)
def test_a_valid_value_is_taken(name, value):
    assert getattr(Every(**{name: value}), name) == value


def test_replace_is_checked_too():
    with pytest.raises(ValueError, match="count must be a whole number of at least 1, got 0"):
        dataclasses.replace(Every(), count=0)


def test_options_are_frozen_hashable_and_taken_by_name_only():
    assert hash(Every()) == hash(Every(count=1))
    assert Every() == Every(count=1) != Every(count=2)
    with pytest.raises(dataclasses.FrozenInstanceError):
        Every().count = 3
    with pytest.raises(ValueError, match="Every takes its options by name, got 3"):
        Every(3)


def test_an_option_that_cannot_be_hashed_is_rejected():
    @options
    class Listed:
        """Options with a list."""

        names: list[str] = dataclasses.field(default_factory=list)

    with pytest.raises(ValueError, match=r"names must be of a type that can be hashed.* got list"):
        Listed()


def test_an_unknown_name_offers_the_nearest_known_one():
    with pytest.raises(ValueError, match=r"unknown option 'cuont': did you mean 'count'\?"):
        Every(cuont=1)
    with pytest.raises(ValueError, match="unknown option 'zzz': known are count, count_or_zero"):
        Every(zzz=1)
    with pytest.raises(ValueError, match="unknown option 'learning_rat': did you mean 'learning_"):
        train_config(learning_rat=1e-3)
    with pytest.raises(ValueError, match=r"unknown option 'num_env': did you mean 'num_envs'\?"):
        TrainConfig(num_env=3)


def leaves(config) -> list[str]:
    names = []
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        names += leaves(value) if dataclasses.is_dataclass(value) else [field.name]
    return names


@pytest.mark.parametrize("task", task_names())
@pytest.mark.parametrize("preset", PRESETS)
def test_names_are_unique_across_all_groups(preset, task):
    config = set_train_options(PRESETS[preset], {"task": task})
    names = leaves(config)
    assert len(names) == len(set(names)) == len(flat_names(config))


@pytest.mark.parametrize("preset", PRESETS)
def test_every_option_goes_through_json(preset):
    config = PRESETS[preset]
    assert parse_config(json.dumps(dump_config(config)), "test") == config
    changed = set_train_options(config, {"camera": ("front", "front"), "size": (32, 48)})
    assert parse_config(json.dumps(dump_config(changed)), "test") == changed
    assert hash(changed) != hash(config)


@pytest.mark.parametrize("preset", PRESETS)
def test_every_option_can_be_set_by_its_name(preset):
    config = PRESETS[preset]
    for name in flat_names(config):
        assert set_train_options(config, {name: get_option(config, name)}) == config


def test_the_table_of_deviations_has_the_numbers_of_the_preset():
    config, table = PRESETS["paper"], " ".join(presets.__doc__.split())
    for text in (
        f"after {config.algo.learning_starts:,} environment steps",
        f"on {config.select_episodes} held-out episodes",
        f"every {config.select_every:,} steps",
        f"{config.num_envs} side by side with one replay of {config.replay.replay_size:,}",
        f"one of {config.algo.batch_size} transitions per step of all {config.num_envs}",
    ):
        assert text in table, text


def test_presets_are_never_mutated():
    before = {name: hash(config) for name, config in PRESETS.items()}
    for config in PRESETS.values():
        set_train_options(config, {"seed": 3, "learning_starts": 7, "lift": 0.1})
    assert {name: hash(config) for name, config in PRESETS.items()} == before


def test_a_configuration_of_version_0_1_is_rejected_in_one_sentence():
    """Its `env` was a name, and its options had no groups and no format."""
    old = {"env": "B", "physics": "native", "num_envs": 64, "cube_moves": "on_success"}
    with pytest.raises(ValueError, match=r"^some\.json was written by mjx_arm 0\.1, ") as raised:
        parse_config(json.dumps(old), "some.json")
    assert "\n" not in str(raised.value)


def test_another_format_is_rejected():
    content = dump_config(train_config()) | {"format": 99}
    with pytest.raises(ValueError, match="has the format 99; this version reads 2"):
        parse_config(json.dumps(content), "some.json")


def edit(change) -> str:
    content = json.loads(json.dumps(dump_config(train_config())))
    change(content)
    return json.dumps(content)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c["env"].update(sise=1), "'env' has an unknown option 'sise': did you mean"),
        (lambda c: c["env"].update(size=[0, 1]), "'env': size must be a tuple of two values"),
        (lambda c: c["env"]["task_options"].update(lift=-1), "'task_options': lift must be a"),
        (lambda c: c["algo"].update(gamma=2), "'algo': gamma must be a finite number above 0"),
        (lambda c: c.update(env=[1]), "'env' must be an object with options, got"),
        (lambda c: c.update(algo=3), "'algo' must be an object with options, got 3"),
        (lambda c: c.update(algorithm="sarsa"), "unknown algorithm in some.json: 'sarsa'"),
        (lambda c: c.update(algorithm=3), "algorithm must be text, got 3"),
        (lambda c: c["env"].update(task="pour"), "unknown task 'pour'"),
        (lambda c: c["env"].update(task=None), "task must be text, got None"),
        (lambda c: c.update(seed=True), "seed must be a whole number of at least 0, got True"),
    ],
)
def test_a_damaged_configuration_is_rejected_by_name(change, message):
    with pytest.raises(ValueError, match=r"some\.json|task") as raised:
        parse_config(edit(change), "some.json")
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


def test_another_task_or_algorithm_comes_with_its_own_options():
    config = set_train_options(train_config(), {"algorithm": "distill", "student_share": 0.25})
    assert config.algo.student_share == 0.25
    with pytest.raises(ValueError, match="unknown option 'batch_size'"):
        set_train_options(config, {"batch_size": 3})
    with pytest.raises(ValueError, match="algo must be of type DQNConfig"):
        dataclasses.replace(config, algorithm="dqn")
    with pytest.raises(ValueError, match="observation must be one of packed to train by 'distil"):
        set_train_options(config, {"observation": "state"})
    assert set_env_options(EnvConfig(), {"task": "lift", "lift": 0.2}).task_options.lift == 0.2


def test_every_option_of_every_class_is_described():
    """The command line's help comes from there."""
    for config in PRESETS.values():
        groups = [config, *(getattr(config, f.name) for f in dataclasses.fields(config))]
        groups.append(config.env.task_options)
        for group in groups:
            if dataclasses.is_dataclass(group):
                for name in option_names(type(group)):
                    assert f"      {name}: " in type(group).__doc__, (type(group), name)


@pytest.mark.parametrize("name", ["task", "algorithm"])
@pytest.mark.parametrize("value", [3.5, None, ["lift"], b"dqn", np.array(["lift", "push"])])
def test_what_is_no_text_is_no_name(name, value):
    with pytest.raises(ValueError, match=f"^{name} must be text, got "):
        train_config(**{name: value})


@pytest.mark.parametrize(
    ("preset", "options", "sentence"),
    [
        ("fast", {}, None),
        ("gpu", {}, None),
        ("fast", {"total_steps": 600_000}, "the agent that is saved learns from step 600,000"),
        ("pixels", {"num_envs": 8_192}, "a chunk has 1 steps of 8192 environments"),
        ("pixels", {"replay_size": 3_200}, "the replay holds 50 steps of each environment"),
        ("pixels", {"num_envs": 512, "chunk_steps": 2**20}, "training samples 0.12 transitions"),
    ],
)
def test_valid_options_that_make_no_sense_get_a_sentence(preset, options, sentence):
    said = advice(set_train_options(PRESETS[preset], options))
    assert all("\n" not in x for x in said)
    if sentence is None:
        assert said == []
    else:
        assert any(x.startswith(sentence) or sentence in x for x in said)


def test_only_the_result_of_several_changes_must_fit_together():
    small = train_config(replay_size=400, batch_size=8)
    taught = {"teacher_batch_size": 16, "student_batch_size": 8}
    config = set_train_options(small, {"algorithm": "distill", **taught})
    assert (config.algorithm, config.algo.teacher_batch_size) == ("distill", 16)
    assert config.replay.replay_size == 400
    with pytest.raises(ValueError, match="replay_size must be at least teacher_batch_size = 512"):
        set_train_options(small, {"algorithm": "distill"})
    pushed = set_train_options(small, {"task": "push", "threshold": 0.02, "algorithm": "dqn"})
    assert (pushed.env.task, pushed.env.task_options.threshold) == ("push", 0.02)


def test_what_a_file_leaves_out_is_as_training_has_it():
    text = '{"format": 2, "replay": {"replay_size": 400}, "algo": {"batch_size": 8}}'
    assert parse_config(text, "c.json") == train_config(replay_size=400, batch_size=8)
    text = '{"format": 2, "env": {"task": "push", "env": "B"}}'
    assert parse_config(text, "c.json") == train_config(task="push", env="B")
