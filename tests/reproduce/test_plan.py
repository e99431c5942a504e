"""What the page is made of, and what it costs."""

from __future__ import annotations

import dataclasses
import json

import pytest
from rich.console import Console

from mjx_arm.cli import main
from mjx_arm.reproduce.plan import make_plan, strongest_ablations
from mjx_arm.reproduce.store import Measured
from mjx_arm.reproduce.trainings import (
    ABLATION_MINUTES,
    ABLATIONS,
    STRONGEST,
    Training,
    ablation_training,
    agent_trainings,
    paper_training,
    reward_trainings,
    run_training,
    shorten,
)
from mjx_arm.scene import load_scene
from mjx_arm.training.run_folder import SavedRun, save_run


def plan_of(tmp_path, **options):
    values = {"runs": None, "shipped": False, "quick": False, "only": ()}
    return make_plan(tmp_path / "page", **(values | options))


def test_without_agents_a_and_b_are_trained(tmp_path):
    names = [training.name for training in plan_of(tmp_path).wanted_trainings()]
    assert names == ["agent-A-seed0", "agent-B-seed0"]
    assert len(plan_of(tmp_path, seeds=3).wanted_trainings()) == 6


@pytest.mark.parametrize("options", [{"shipped": True}, {"only": ("figure1",)}])
def test_nothing_is_trained_that_was_not_asked_for(tmp_path, options):
    assert plan_of(tmp_path, **options).wanted_trainings() == []


@pytest.mark.parametrize("section", ["reward", "paper", "ablations", "pixels"])
def test_a_study_is_trained_when_it_is_named(tmp_path, section):
    plan = plan_of(tmp_path, shipped=True, only=(section,))
    assert plan.wanted_trainings()
    assert section not in plan_of(tmp_path, shipped=True).chosen


def test_one_cell_can_be_asked_for(tmp_path):
    plan = plan_of(tmp_path, shipped=True, only=("ablation-A-gamma",))
    assert [training.name for training in plan.wanted_trainings()] == ["ablation-A-gamma"]


def test_the_budgets_are_those_of_the_study():
    tried = [each for each in ABLATIONS if each.changes is not None]
    cells = len(tried) + 1 + STRONGEST + 1
    assert ABLATION_MINUTES <= 15
    assert cells * ABLATION_MINUTES <= 180
    for ablation in tried:
        for env in ("A", "B"):
            training = ablation_training(ablation.name, env)
            assert training.minutes == ABLATION_MINUTES
            assert training.config.env.env == env
    assert paper_training().config.total_steps == 1_000_000
    assert paper_training().config.exploration.epsilon_steps == 1_000_000


def test_rewards_differ_in_nothing_but_the_reward_and_the_discount():
    runs = [training.config for training in reward_trainings()]
    assert {config.env.env for config in runs} == {"A"}
    bare = {
        dataclasses.replace(
            config,
            seed=0,
            env=dataclasses.replace(config.env, reward="completion"),
            algo=dataclasses.replace(config.algo, gamma=0.99),
        )
        for config in runs
    }
    assert len(bare) == 1
    assert sorted({config.seed for config in runs}) == [0, 1]


def test_every_training_has_hours_and_a_quick_form():
    for training in (*agent_trainings("agents"), *reward_trainings(), paper_training()):
        assert 0.1 < training.hours < 5
        quick = shorten(training)
        assert quick.config.total_steps < 20_000
        assert quick.hours < 0.05


def write_rate(plan, name: str, rate: float) -> None:
    (cell,) = [cell for cell in plan.cells if cell.name == name]
    inputs = json.loads(json.dumps(cell.inputs()))
    plan.store.write(Measured(name, "", inputs, {"rate": rate}, (), {}, 0.0, ""), {})


def strongest(plan) -> list[str]:
    return strongest_ablations(plan.store, plan.cells)


def write_rates(plan) -> None:
    rates = {"gamma": 0.2, "loss": 0.95, "replay": 0.5}
    write_rate(plan, "ablation-A-default", 0.8)
    for ablation in ABLATIONS:
        if ablation.changes is not None:
            assert strongest(plan) == []
            write_rate(plan, f"ablation-A-{ablation.name}", rates.get(ablation.name, 0.8))


def test_the_strongest_changes_are_known_when_all_are_measured(tmp_path):
    plan = plan_of(tmp_path)
    plan.store.prepare()
    write_rates(plan)
    assert strongest(plan) == ["gamma", "replay", "loss"]
    planned = [training.name for training in plan_of(tmp_path).trainings]
    assert [name for name in planned if name.startswith("ablation-B")] == [
        f"ablation-B-{name}" for name in ("default", "gamma", "replay", "loss")
    ]


def test_the_strongest_changes_of_a_quick_run_are_not_those_of_the_study(tmp_path):
    quick = plan_of(tmp_path, quick=True)
    quick.store.prepare()
    write_rates(quick)
    assert strongest(quick) == ["gamma", "replay", "loss"]
    plan = plan_of(tmp_path)
    assert strongest(plan) == []
    assert not any(training.name.startswith("ablation-B") for training in plan.trainings)


def test_fewer_environments_sample_as_much_for_each_step():
    samples = []
    for name in ("default", "environments"):
        config = ablation_training(name, "A").config
        algo = config.algo
        samples.append(
            (
                algo.teacher_batch_size * algo.teacher_updates_per_step / config.num_envs,
                algo.student_batch_size * algo.student_updates_per_step / config.num_envs,
            )
        )
    assert samples == [(8.0, 3.0)] * 2


def save_finished(training: Training, folder) -> None:
    """The files by which a finished run is known."""
    folder.mkdir(parents=True)
    save_run(folder, SavedRun(training.config, {}, load_scene("arm_cube").source))
    (folder / "evaluation.json").write_text("{}")


def test_a_finished_run_of_other_options_is_rejected(tmp_path):
    options = {"only": ("reward-completion-seed0",)}
    quick, plan = plan_of(tmp_path, quick=True, **options), plan_of(tmp_path, **options)
    (short,), (wanted,) = quick.wanted_trainings(), plan.wanted_trainings()
    save_finished(short, quick.run_folder(short))
    assert quick.wanted_trainings() == []
    assert plan.wanted_trainings() == [wanted]
    with pytest.raises(ValueError, match=r"other options than 'reward-completion-seed0' has now"):
        run_training(wanted, plan.run_folder(wanted), Console(quiet=True))


@pytest.mark.parametrize("name", ["agent-A-seed0", "pixels-A-seed0"])
def test_an_agent_of_a_quick_run_is_not_shown_as_the_trained_one(tmp_path, name):
    quick = plan_of(tmp_path, quick=True)
    short = next(each for each in quick.trainings if each.name == name)
    save_finished(short, quick.run_folder(short))
    (quick.run_folder(short) / "last.safetensors").write_bytes(b"")
    folder = str(quick.run_folder(short))
    shown = [{x.agent for x in plan_of(tmp_path, quick=q).subjects} for q in (True, False)]
    assert folder in shown[0]
    assert folder not in shown[1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--only", "figur1"], "unknown section or cell 'figur1': did you mean 'figure1'?"),
        (["--runs", "nowhere"], "--runs nowhere is not a folder"),
        (["--runs", "."], "--runs . holds no run folder"),
        (["--out", "file", "--shipped", "--only", "page"], "cannot be made"),
        (["--seeds", "0"], "seeds must be a whole number of at least 1"),
        (["page"], "unexpected argument 'page'"),
        (["--quik"], "unknown option '--quik': did you mean '--quick'?"),
    ],
)
def test_bad_input_gets_one_sentence(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    assert main(["reproduce", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_page_without_any_cell_names_every_command(tmp_path, capsys):
    out = tmp_path / "the page"
    assert main(["reproduce", "--shipped", "--only", "page", "--out", str(out)]) == 0
    page = (out / "index.html").read_text()
    for part in (
        *("figure1-arm_cube", "figure2-taught-A-seed0", "episodes-taught-B-seed0-in-A"),
        *("figure4-taught-B-seed0", "reward-published-seed0", "paper-A", "ablation-A-gamma"),
        "python benchmarks/transfer.py taught-A-seed0=agent-a taught-B-seed0=agent-b --levels near",
        "python benchmarks/feature_maps.py taught-A-seed0=agent-a taught-B-seed0=agent-b --page",
    ):
        assert part in page
    assert "http" not in page.replace("http-equiv", "")
    text = (out / "index.md").read_text()
    assert f"\nmjx-arm reproduce --shipped --out '{out}'\n" in text
    assert f" --levels near medium far --out '{out}/cells'\n" in text
    assert f" --page '{out}'\n" in text


def test_options_of_a_cell_that_changed_make_it_missing(tmp_path):
    plan = plan_of(tmp_path, shipped=True)
    plan.store.prepare()
    cell = next(cell for cell in plan.cells if cell.name.startswith("episodes-"))
    inputs = json.loads(json.dumps(cell.inputs()))
    plan.store.write(Measured(cell.name, "", inputs, {}, (), {}, 0.0, ""), {})
    assert plan.read(cell.name) is not None
    assert plan_of(tmp_path, shipped=True, quick=True).read(cell.name) is None
