"""The parts of the page about the studies, from files as the measurements leave them."""

from __future__ import annotations

import json

import pytest
from made_cells import MACHINE
from made_runs import make_run

from mjx_arm.reproduce import command, studies
from mjx_arm.reproduce.curves import read_curve
from mjx_arm.reproduce.page import write_pages
from mjx_arm.reproduce.plan import make_plan
from mjx_arm.reproduce.records import CAUSES, HEIGHT_EDGES
from mjx_arm.reproduce.store import Measured
from mjx_arm.reproduce.studies import measure_ablation, measure_paper, measure_reward
from mjx_arm.reproduce.trainings import ABLATIONS
from mjx_arm.reproduce.trials import Trial
from mjx_arm.training.evaluate import wilson_interval


@pytest.fixture
def run(tmp_path):
    make_run(tmp_path / "run", (90,), env="A")
    return tmp_path / "run"


def plan_of(out):
    return make_plan(out, runs=None, shipped=True, quick=False, only=())


def write(plan, name, result):
    """A cell with the inputs that the plan wants."""
    (cell,) = [cell for cell in plan.cells if cell.name == name]
    inputs = json.loads(json.dumps(cell.inputs()))
    plan.store.write(Measured(name, "", inputs, result, (), MACHINE, 1.0, "2026-01-01"), {})


def trial(successes, episodes=100):
    """What `measure_episodes` says of episodes in which the cube was held at 25 cm."""
    steps = [0] * (len(HEIGHT_EDGES) - 1)
    steps[25] = 40
    return {
        "episodes": episodes,
        "successes": successes,
        "rate": successes / episodes,
        "ci95": list(wilson_interval(successes, episodes)),
        "held_not_lifted": episodes - successes,
        "causes": dict.fromkeys(CAUSES, 0),
        "heights": {
            "edges": list(HEIGHT_EDGES),
            "steps": steps,
            "grasped_steps": 40,
            "all_steps": 100,
            "hovering_steps": 30,
        },
    }


def reward_result(run, seed, gamma, hovering, successes):
    worth = {"a_step_of_hovering": hovering, "hovering_for_ever": hovering / (1 - gamma)}
    return trial(successes) | {
        "gamma": gamma,
        "train_seed": seed,
        "worth": worth | {"success": 100.0},
        "curve": read_curve(run, 0.2),
    }


def text_of(plan):
    write_pages(plan)
    return (plan.store.folder / "index.md").read_text()


def test_the_reward_is_worth_what_the_calculation_says(tmp_path, run):
    plan = plan_of(tmp_path / "page")
    plan.store.prepare()
    for seed in (0, 1):
        result = reward_result(run, seed, 0.99, 1.325, 20 + seed)
        write(plan, f"reward-published-seed{seed}", result)
    write(plan, "reward-published-98-seed0", reward_result(run, 0, 0.98, 1.325, 95))
    text = text_of(plan)
    assert "| published, γ = 0.99 | 1.325 / (1 - 0.99) = 132.5 | 100 | hover | 10.0 |" in text
    assert "| published, γ = 0.98 | 1.325 / (1 - 0.98) = 66.2 | 100 | finish | 10.0 |" in text
    assert "| 20.0 % | 13.3 to 28.9 | 40.0 % | 30.0 % | 80.0 % |" in text
    assert "![Histograms of the cube's height" in text
    # What is not there is named.
    assert "Not measured yet: `reward-completion-seed0`" in text
    assert (
        "--only reward-completion-seed0 reward-completion-seed1 reward-shaped-seed0 "
        "reward-shaped-seed1 reward-published-98-seed1" in text
    )


def test_the_preset_paper_is_reported_both_ways(tmp_path, run):
    plan = plan_of(tmp_path / "page")
    plan.store.prepare()
    trials = {"epsilon 0.1": trial(2), "greedy": trial(0)}
    write(plan, "paper-A", {"curve": read_curve(run, 1.0), "trials": trials})
    text = text_of(plan)
    assert "| ε = 0.1 | 2.0 % |" in text
    assert "| greedy | 0.0 % |" in text


def test_the_last_agent_of_a_study_is_judged(run, monkeypatch):
    judged = []

    def measure(name, path, trial, pictures):
        judged.append(path)
        return {"episodes_each": {}}, {}

    monkeypatch.setattr(studies, "measure_episodes", measure)
    measure_reward("reward", run, Trial("A", 1))
    measure_paper("paper", run, {"greedy": Trial("A", 1)})
    assert judged == [str(run / "last.safetensors")] * 2


def test_each_change_has_its_difference_and_a_sentence(tmp_path, run):
    plan = plan_of(tmp_path / "page")
    plan.store.prepare()
    result, _ = measure_ablation(run)
    write(plan, "ablation-A-default", result)
    for ablation in ABLATIONS:
        if ablation.changes is not None:
            worse = result | {"successes": 50, "rate": 0.5}
            write(plan, f"ablation-A-{ablation.name}", worse if ablation.name == "loss" else result)
    # Now the strongest are known, and are planned in B.
    plan = plan_of(tmp_path / "page")
    text = text_of(plan)
    assert "| the default preset | 90.0 % | 82.6 to 94.5 | – | 60,000 | the reference |" in text
    assert "| 50.0 % | 40.4 to 59.6 | -40.0 (" in text
    assert "Worse than the default in this seed." in text
    assert "No clear difference." in text
    assert "Not tried: a distributional head." in text
    assert "`ablation-B-default`, `ablation-B-loss`" in text
    assert "| ablation-A-gamma | fast | 0 | `gamma` 0.98 |" in text


def test_the_last_change_in_a_puts_the_changes_in_b_on_the_same_page(tmp_path, run, monkeypatch):
    result, _ = measure_ablation(run)
    monkeypatch.setattr(command, "run_training", lambda *arguments: None)
    monkeypatch.setattr(
        command, "_measure", lambda plan, cell, console: write(plan, cell.name, result)
    )
    page = command.reproduce(tmp_path / "page", shipped=True, only=("ablations",))
    assert "Not measured yet: `ablation-B-default`" in page.with_name("index.md").read_text()
