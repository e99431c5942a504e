"""Curves: what their axes, legends and empty panels say."""

from __future__ import annotations

import html
import json
import pathlib
import re

import jax
import numpy as np
import pytest
from made_runs import make_run, row

import mjx_arm
from mjx_arm.envs.tasks import find_task
from mjx_arm.report.figures import draw_groups, draw_panels, plot_curves
from mjx_arm.training.run_folder import seed_folders

UNITS = {"distance": "m"}
TITLES = [
    *("success rate", "loss", "mean distance", "grasped"),
    *("cumulative successes", "mean reward", "mean maximum Q"),
]


def words(picture: bytes) -> list[str]:
    """The texts of an SVG picture, which matplotlib draws as paths beside a comment."""
    return [html.unescape(text) for text in re.findall(r"<!-- (.*?) -->", picture.decode())]


def has_band(picture: bytes) -> bool:
    """Whether an SVG picture has an area between two curves."""
    return b"PolyCollection" in picture


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> pathlib.Path:
    folder = tmp_path_factory.mktemp("figures") / "run"
    make_run(folder)
    return folder


@pytest.fixture(scope="module")
def seeds(tmp_path_factory) -> list[pathlib.Path]:
    folder = tmp_path_factory.mktemp("figures") / "seeds"
    config = make_run(folder, (90, 70, 80), seed=4)
    folders = seed_folders(folder, config)
    for scale, own in zip((1.0, 1.1, 1.2), folders, strict=True):
        rows = [json.loads(line) for line in (own / "metrics.jsonl").read_text().splitlines()]
        for each in rows:
            each["mean_reward"] *= scale
        (own / "metrics.jsonl").write_text("".join(json.dumps(each) + "\n" for each in rows))
    return folders


def test_every_panel_has_a_title_and_a_unit_on_both_axes(run):
    pictures = dict(draw_panels([run], units=UNITS))
    assert list(pictures) == TITLES
    expected = {
        "success rate": ("environment steps", "share of episodes"),
        "loss": ("environment steps", "loss"),
        "mean distance": ("environment steps", "m"),
        "grasped": ("environment steps", "share of steps"),
        "cumulative successes": ("episodes", "episodes"),
        "mean reward": ("episodes", "reward per step"),
        "mean maximum Q": ("episodes", "Q-value"),
    }
    for title, labels in expected.items():
        said = words(pictures[title])
        for text in (title, *labels):
            assert said.count(text) == (title, *labels).count(text), (title, text)


def test_a_metric_without_a_unit_is_a_mean_of_a_step(run):
    assert "mean of a step" in words(dict(draw_panels([run], units={}))["mean distance"])


@pytest.mark.parametrize("task", ["lift", "reach", "push"])
def test_a_shipped_task_names_the_unit_of_each_number_that_it_measures(task):
    env = mjx_arm.make("A", task=task, physics="native", observation="state")
    measured = jax.eval_shape(
        lambda key: env.task.measure(env.reset(key)[1]), jax.eval_shape(lambda: jax.random.key(0))
    )
    numbers = {name for name, x in measured.items() if x.dtype == np.float32}
    assert set(find_task(task).units) == numbers


def test_one_run_has_raw_and_smoothed_lines_and_no_band(run):
    for title, picture in draw_panels([run], units=UNITS):
        said = words(picture)
        assert {"raw", "smoothed"} <= set(said), title
        assert ("held-out episodes" in said) == (title == "success rate")
        assert not has_band(picture)


def test_several_seeds_have_names_a_mean_and_a_band(seeds):
    for title, picture in draw_panels(seeds, units=UNITS):
        said = words(picture)
        assert {"seed-4", "seed-5", "seed-6", "mean"} <= set(said), title
        assert not {"raw", "smoothed"} & set(said)
        assert has_band(picture)


def test_pictures_of_several_runs_name_each_run(run, seeds):
    for title, picture in draw_groups({"one": [run], "three": seeds}, units=UNITS):
        assert {"one", "three"} <= set(words(picture)), title
        assert has_band(picture)


def test_an_empty_panel_says_why(tmp_path):
    make_run(tmp_path / "run")
    missing = dict.fromkeys(
        ("success_rate", "mean_reward", "mean_max_q", "loss", "mean_distance", "grasped_share")
    )
    only = row(200, rate=None) | {"episodes": 0.0, "successes": 0.0} | missing
    (tmp_path / "run/metrics.jsonl").write_text(json.dumps(only) + "\n")
    pictures = dict(draw_panels([tmp_path / "run"], units=UNITS))
    reasons = {
        "success rate": "no episode has ended yet",
        "loss": "no update yet",
        "mean distance": "no step yet",
        "grasped": "no step yet",
        "mean reward": "no episode has ended yet",
        "mean maximum Q": "no episode has ended yet",
    }
    for title, reason in reasons.items():
        said = words(pictures[title])
        assert reason in said
        assert "smoothed" not in said
    # A count is known from the beginning.
    assert not any("yet" in text for text in words(pictures["cumulative successes"]))


def test_both_pictures_of_a_run_are_written(run, tmp_path):
    paths = plot_curves([run], into=tmp_path, units=UNITS)
    assert [path.name for path in paths] == ["figure3.png", "learning.png"]
    assert all(path.stat().st_size > 10_000 for path in paths)
