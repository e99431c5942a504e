"""What a sweep varies, as it is written on the command line."""

from __future__ import annotations

import re

import optuna
import pytest

from mjx_arm.config import TrainConfig, train_config
from mjx_arm.tools.search_space import Dimension, check_space, parse_space, suggest

CONFIG = TrainConfig()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("learning-rate=1e-4..1e-2:log", Dimension("learning_rate", 1e-4, 1e-2, log=True)),
        ("n-step=1..5", Dimension("n_step", 1, 5)),
        ("gamma=0.9..0.99", Dimension("gamma", 0.9, 0.99)),
        ("hidden=64,128", Dimension("hidden", choices=(64, 128))),
        ("reward=paper,completion", Dimension("reward", choices=("paper", "completion"))),
        ("lift=0.1..0.3", Dimension("lift", 0.1, 0.3)),
    ],
)
def test_a_dimension_is_read(text, expected):
    assert parse_space([text], CONFIG) == (expected,)


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        ([], "--search needs at least one option to vary: give NAME=LOW..HIGH"),
        (["hidden"], "--search cannot read 'hidden': give NAME=LOW..HIGH"),
        (["hiden=1,2"], "unknown option in --search: 'hiden': did you mean 'hidden'?"),
        (["seed=1,2"], "--search cannot vary seed: trials would not be comparable"),
        (["n-step=5..1"], "5..1 must be two numbers, the lower one first"),
        (["n-step=0..3"], "n_step must be a whole number of at least 1, got 0"),
        (["n-step=1..2.5"], "n-step must be a whole number of at least 1, got '2.5'"),
        (["gamma=0.5..0.9:ln"], "0.5..0.9:ln is not a range"),
        (["joint-noise=0..9:log"], "log needs LOW > 0"),
        (["n-step=1,2", "n-step=3..4"], "--search names n-step twice: give it once"),
    ],
)
def test_what_cannot_be_varied_is_rejected(texts, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        parse_space(texts, CONFIG)


def test_values_that_do_not_fit_the_other_options_are_rejected():
    config = train_config(replay_size=1_000)
    with pytest.raises(ValueError, match="replay_size must be at least batch_size = 2000"):
        check_space(parse_space(["batch-size=32,2000"], config), config)


def test_a_trial_gets_values_from_the_space():
    texts = ["learning-rate=1e-4..1e-2:log", "n-step=1..5", "hidden=64,128"]
    space = parse_space(texts, CONFIG)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    found = [suggest(study.ask(), space) for _ in range(30)]
    assert {values["hidden"] for values in found} == {64, 128}
    assert {values["n_step"] for values in found} == {1, 2, 3, 4, 5}
    rates = sorted(values["learning_rate"] for values in found)
    assert 1e-4 <= rates[0] < rates[-1] <= 1e-2
    # The median of a logarithmic scale is near 1e-3, that of a linear one near 5e-3.
    assert 3e-4 < rates[15] < 3e-3
