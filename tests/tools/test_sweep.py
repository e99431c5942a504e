"""A sweep: its trials, what is pruned, and that it continues where it was stopped."""

from __future__ import annotations

import sys

import pytest
from rich.console import Console

from mjx_arm.cli import main
from mjx_arm.config import train_config
from mjx_arm.envs.tasks import register
from mjx_arm.envs.tasks.reach import Reach, ReachConfig
from mjx_arm.options import Positive, options
from mjx_arm.report.metrics import read_metrics
from mjx_arm.tools.search_space import Dimension
from mjx_arm.tools.sweep import describe_sweep, import_optuna, sweep
from mjx_arm.training.run_folder import load_config


@options
class AlwaysConfig(ReachConfig):
    """Options of a task in which every step is a success."""

    threshold: Positive = 10.0

    def check(self) -> None:
        """Lets episodes start in success."""


@options
class NeverConfig(ReachConfig):
    """Options of a task in which no step is a success."""

    threshold: Positive = 1e-6


register("always", Reach, config=AlwaysConfig, scene="arm_reach")
register("never", Reach, config=NeverConfig, scene="arm_reach")

CONFIG = train_config(
    task="always",
    observation="state",
    physics="native",
    num_envs=4,
    replay_size=400,
    batch_size=8,
    learning_starts=40,
    chunk_steps=80,
    total_steps=240,
    max_steps=15,
    hidden=16,
    select_every=80,
    select_episodes=2,
)
SPACE = (Dimension("task", choices=("never", "always")),)


@pytest.mark.slow
def test_a_trial_that_is_worse_than_the_median_is_pruned(tmp_path, capsys):
    # With seed 0 the first trial always succeeds, and the second one never does.
    assert CONFIG.seed == 0
    first, second = sweep(
        CONFIG, SPACE, tmp_path / "sweep", trials=2, eval_episodes=2, console=Console()
    )
    assert (first.number, first.state, first.value) == (0, "complete", 1.0)
    assert (second.number, second.state, second.value) == (1, "pruned", None)
    assert [trial.values["task"] for trial in (first, second)] == ["always", "never"]
    # Of three chunks, and three selections.
    assert (len(read_metrics(first.folder)), len(read_metrics(second.folder))) == (3, 1)
    assert "trial 1: pruned after 80 steps at 0.0 %" in capsys.readouterr().out


@pytest.mark.long
def test_a_sweep_ranks_prunes_and_continues(tmp_path):
    first = sweep(CONFIG, SPACE, tmp_path / "sweep", trials=2, eval_episodes=2)
    assert [trial.number for trial in sorted(first, key=lambda trial: trial.number)] == [0, 1]
    trials = sweep(CONFIG, SPACE, tmp_path / "sweep", trials=6, eval_episodes=2)
    assert len(trials) == 6
    assert {trial.number for trial in trials} == set(range(6))
    good = [trial for trial in trials if trial.values["task"] == "always"]
    bad = [trial for trial in trials if trial.values["task"] == "never"]
    assert good
    assert bad
    assert trials[: len(good)] == good
    assert {trial.value for trial in good} == {1.0}
    for trial in trials:
        assert load_config(trial.folder).env.task == trial.values["task"]
        assert not (trial.folder / "policy.mp4").exists()
        rows = read_metrics(trial.folder)
        assert (trial.folder / "report.html").is_file() == (trial.state == "complete")
        # A pruned trial did not run to its end.
        assert (len(rows) < 3) == (trial.state == "pruned")
    assert "pruned" in {trial.state for trial in trials}
    content = (tmp_path / "sweep" / "sweep.html").read_text()
    assert "data:image/svg+xml" in content
    assert describe_sweep(trials, SPACE).count("\n") == 6
    with pytest.raises(ValueError, match="holds a sweep with other options: give --out another"):
        sweep(CONFIG, (Dimension("n_step", 1, 2),), tmp_path / "sweep", trials=7)


def test_a_trial_that_cannot_be_trained_is_pruned_and_one_that_was_cut_off_made_up_for(tmp_path):
    space = (Dimension("replay_size", choices=(2**31 - 8, 2**31 - 4)),)
    trials = sweep(CONFIG, space, tmp_path, trials=2)
    assert [trial.state for trial in trials] == ["pruned", "pruned"]
    # As a signal leaves a trial.
    optuna = import_optuna()
    journal = optuna.storages.journal.JournalFileBackend(str(tmp_path / "sweep.journal"))
    storage = optuna.storages.JournalStorage(journal)
    optuna.load_study(study_name="mjx_arm", storage=storage).ask()
    trials = sweep(CONFIG, space, tmp_path, trials=3)
    assert [trial.state for trial in trials] == ["pruned", "pruned", "fail", "pruned"]
    assert (tmp_path / "sweep.html").read_text().count("pruned") >= 3
    # What fails once it has begun is no fault of the options, and ends the sweep.
    (tmp_path / "trial-004").mkdir()
    (tmp_path / "trial-004" / "config.json").touch()
    with pytest.raises(ValueError, match="trial-004 is not empty"):
        sweep(CONFIG, space, tmp_path, trials=4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "--search needs at least one option to vary"),
        (["--search", "n-step=1..3", "--trials", "0"], "trials must be a whole number of at least"),
        (["--search", "n-step=1..3", "--minutes", "-1"], "minutes must be a finite number above 0"),
        (["--search", "n-step=1..3", "--select-every", "0"], "select_every must be above 0"),
        (["--search", "n-step=1..3", "--out", "full"], "full is not empty and holds no sweep"),
        (["--searches", "n-step=1..3"], "unknown option '--searches': did you mean '--search'?"),
    ],
)
def test_bad_input_gets_one_sentence(arguments, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").touch()
    assert main(["sweep", "--preset", "pixels", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["full"]


def test_a_missing_extra_is_named(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    assert main(["sweep", "--search", "n-step=1..3"]) == 2
    assert capsys.readouterr().err == (
        "error: a sweep needs the extra 'sweep': pip install 'mjx-arm[sweep]'\n"
    )
