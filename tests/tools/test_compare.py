"""Runs side by side: the intervals, what is said about them, and the page."""

from __future__ import annotations

import json

import pytest
from made_runs import make_run

from mjx_arm.cli import main
from mjx_arm.tools.compare import (
    describe,
    difference,
    different_options,
    read_result,
    read_results,
    remarks,
    write_comparison,
)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """One seed in B; three seeds in B; one seed in A that was never selected at 90 %."""
    root = tmp_path_factory.mktemp("runs")
    make_run(root / "one", (90,), env="B")
    make_run(root / "three", (80, 85, 90), env="B", learning_rate=1e-3)
    make_run(root / "other", (50,), env="A", selections=(None, 0.3))
    return root


def test_one_seed_has_an_interval_over_episodes(runs):
    share = read_result(runs / "one").share
    assert share.over == "episodes"
    # Wilson 1927, worked out by hand for 90 of 100.
    assert (share.rate, share.low, share.high) == pytest.approx((0.9, 0.8256, 0.9448), abs=1e-4)


def test_several_seeds_have_an_interval_over_seeds(runs):
    share = read_result(runs / "three").share
    assert share.over == "seeds"
    # 0.85 +- 4.3027 * 0.05 / sqrt(3), Student's t with two degrees of freedom.
    assert (share.rate, share.low, share.high) == pytest.approx((0.85, 0.7258, 0.9742), abs=1e-4)


def test_two_runs_of_one_seed_differ_by_newcombes_interval(runs):
    one, other = read_result(runs / "one"), read_result(runs / "other")
    middle, low, high = difference(other, one)
    assert middle == pytest.approx(0.4)
    assert 0.27 < low < 0.4 < high < 0.52
    assert difference(one, other) == pytest.approx((-middle, -high, -low))


def test_two_runs_of_several_seeds_differ_by_welchs_interval(runs, tmp_path):
    make_run(tmp_path / "better", (90, 95, 100), env="B")
    middle, low, high = difference(read_result(runs / "three"), read_result(tmp_path / "better"))
    # Equal variances: four degrees of freedom, 2.7764 * 0.05 * sqrt(2 / 3).
    assert middle == pytest.approx(0.1)
    assert high - middle == pytest.approx(middle - low) == pytest.approx(0.11335, abs=1e-5)


def test_seeds_that_agree_have_an_interval_over_all_episodes(tmp_path):
    make_run(tmp_path / "all", (100, 100, 100), env="B")
    make_run(tmp_path / "most", (90, 90, 90), env="B")
    most, all_ = read_results([tmp_path / "most", tmp_path / "all"])
    assert all_.share.over == "episodes"
    # Wilson 1927 for 300 of 300: 300 / (300 + 1.96**2).
    assert (all_.share.low, all_.share.high) == pytest.approx((0.98736, 1.0), abs=1e-4)
    middle, low, high = difference(most, all_)
    assert middle == pytest.approx(0.1)
    assert 0.05 < low < middle < high < 0.15


def test_names_are_as_long_as_it_takes_to_tell_runs_apart(tmp_path):
    folders = [tmp_path / name for name in ("a/seed-0", "b/seed-0", "c")]
    for folder in folders:
        folder.parent.mkdir(exist_ok=True)
        make_run(folder, (90,), env="B")
    results = read_results(folders)
    assert [result.name for result in results] == ["a/seed-0", "b/seed-0", "c"]
    with pytest.raises(ValueError, match="seed-0 is given twice"):
        read_results([folders[0], tmp_path / "b" / ".." / "a" / "seed-0"])


def test_one_seed_and_several_are_not_subtracted(runs):
    assert difference(read_result(runs / "one"), read_result(runs / "three")) is None


def test_the_first_selection_that_reached_a_level_is_reported(runs):
    assert read_result(runs / "one").reached == ((40_000, 40), (60_000, 60))
    assert read_result(runs / "other").reached == (None, None)


def test_what_makes_runs_hard_to_compare_is_said(runs):
    said = remarks([read_result(runs / name) for name in ("one", "three", "other")])
    assert "not judged in the same environment: env differ" in said[0]
    assert "others over seeds" in said[1]
    assert remarks([read_result(runs / "three")]) == []


def test_options_that_differ_are_listed(runs):
    rows = different_options([read_result(runs / "one"), read_result(runs / "three")])
    assert rows == [("num-seeds", ("1", "3")), ("learning-rate", ("0.0003", "0.001"))]


def test_a_run_that_was_not_evaluated_has_no_rate(runs, tmp_path):
    make_run(tmp_path / "new", (1,))
    (tmp_path / "new" / "evaluation.json").unlink()
    result = read_result(tmp_path / "new")
    assert result.share is None
    assert difference(read_result(runs / "one"), result) is None
    assert describe([result]).splitlines()[1].split()[:4] == ["new", "1", "–", "–"]


def test_the_command_prints_a_table_and_writes_a_page(runs, tmp_path, capsys):
    page = tmp_path / "comparison.html"
    folders = [str(runs / name) for name in ("one", "other")]
    assert main(["compare", *folders, "--out", str(page)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "90.0 %" in lines[1]
    assert "-40.0 (-50.6 to -27.4)" in lines[2] or "-40.0 (" in lines[2]
    content = page.read_text()
    assert content.count("data:image/svg+xml") == 7
    assert "Options that differ" in content


def test_the_command_prints_json(runs, capsys):
    assert main(["compare", str(runs / "one"), str(runs / "three"), "--json"]) == 0
    one, three = json.loads(capsys.readouterr().out)
    assert one["success"]["over"] == "episodes"
    assert three["seeds"] == 3
    assert three["reached"]["0.5"] == [40_000, 40]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "compare needs RUNS, run folders"),
        (["nowhere"], "nowhere is not a run folder: it has no config.json"),
        (["one", "--out", "page.pdf"], "give a path ending in .html in a folder"),
        (["one", "--out", "nowhere/page.html"], "give a path ending in .html in a folder"),
    ],
)
def test_bad_input_gets_one_sentence(arguments, message, runs, capsys, monkeypatch):
    monkeypatch.chdir(runs)
    assert main(["compare", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_name_cannot_become_a_tag(tmp_path):
    make_run(tmp_path / "<b>")
    write_comparison([read_result(tmp_path / "<b>")], tmp_path / "page.html")
    assert "<b>" not in (tmp_path / "page.html").read_text()
