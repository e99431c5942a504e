"""Reading `metrics.jsonl`: a damaged line is named, by the library and by the command line."""

from __future__ import annotations

import json

import pytest
from made_runs import make_run, row

from mjx_arm.cli import main
from mjx_arm.report.figures import plot_curves
from mjx_arm.report.metrics import keep_metrics, read_metrics


def write_rows(folder, rows):
    (folder / "metrics.jsonl").write_text("".join(json.dumps(each) + "\n" for each in rows))


def rows(count=4):
    return [row(10_000 * (i + 1), rate=None) for i in range(count)]


@pytest.mark.parametrize("count", [2, 4])
@pytest.mark.parametrize("name", ["loss", "mean_distance", "episodes"])
def test_a_line_without_a_metric_is_named(name, count, tmp_path):
    for damaged in range(count):
        found = rows(count)
        del found[damaged][name]
        write_rows(tmp_path, found)
        message = rf"metrics\.jsonl, line {damaged + 1} is damaged"
        for read in (
            read_metrics,
            lambda folder: keep_metrics(folder, 10_000),
            lambda folder: plot_curves([folder], into=folder, units={}),
        ):
            with pytest.raises(ValueError, match=message):
                read(tmp_path)


def test_a_line_with_a_metric_of_another_name_is_named(tmp_path):
    for damaged in range(4):
        found = rows()
        found[damaged]["lors"] = found[damaged].pop("loss")
        write_rows(tmp_path, found)
        with pytest.raises(ValueError, match=rf"line {damaged + 1} is damaged: it lacks 'loss'"):
            read_metrics(tmp_path)


@pytest.mark.parametrize(
    "value", ["true", '"0.5"', "[1]", "{}", "NaN", "Infinity", "1e400", "1" + "0" * 400]
)
def test_a_value_that_is_no_number_is_named(value, tmp_path):
    write_rows(tmp_path, rows())
    path = tmp_path / "metrics.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    assert '"loss": 0.02' in lines[2]
    lines[2] = lines[2].replace('"loss": 0.02', f'"loss": {value}')
    path.write_text("".join(lines))
    with pytest.raises(ValueError, match=r"metrics\.jsonl, line 3 is damaged"):
        read_metrics(tmp_path)


@pytest.mark.parametrize("name", ["env_steps", "wall_s", "episodes", "successes"])
def test_a_metric_that_is_always_known_may_not_be_null(name, tmp_path):
    found = rows()
    found[1][name] = None
    write_rows(tmp_path, found)
    with pytest.raises(ValueError, match=r"metrics\.jsonl, line 2 is damaged"):
        read_metrics(tmp_path)


def test_a_run_that_another_version_continued_has_more_metrics(tmp_path):
    write_rows(tmp_path, [*rows(2), row(30_000, rate=0.5) | {"new": 1.0}])
    assert [len(each) for each in read_metrics(tmp_path)] == [15, 15, 16]
    for path in plot_curves([tmp_path], into=tmp_path, units={}):
        assert path.is_file()


def test_the_command_line_says_it_in_one_sentence(tmp_path, capsys):
    make_run(tmp_path / "run")
    path = tmp_path / "run" / "metrics.jsonl"
    path.write_text(path.read_text().replace('"loss"', '"lors"', 1))
    assert main(["figures", str(tmp_path / "run")]) == 2
    error = capsys.readouterr().err
    assert "metrics.jsonl, line 1 is damaged: it lacks 'loss', which other lines have" in error
    assert error.count("\n") == 1
