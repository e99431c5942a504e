"""The page of a run: what is on it, and that it needs nothing but itself."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import pytest
from made_runs import make_run

from mjx_arm.report import html
from mjx_arm.report.run_page import duration, read_evaluation, write_report


class _Page(HTMLParser):
    """The addresses in a page, its text, and the tags that are open."""

    def __init__(self, content: str):
        super().__init__()
        self.addresses: list[str] = []
        self.words: list[str] = []
        self.open: list[str] = []
        self.feed(content)

    def handle_starttag(self, tag, attrs):
        self.addresses += [value for name, value in attrs if name in ("src", "href")]
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "a<b>&'c"
    config = make_run(folder, env="B", reward="completion", total_steps=60_000)
    (folder / "policy.mp4").write_bytes(b"not shown")
    return write_report(folder, config, [folder]), config


def test_the_page_shows_the_run(run):
    page = _Page(run[0].read_text())
    words = " ".join(page.words)
    assert "a<b>&'c" in words
    for expected in (
        "90.0 %",
        "82.6 to 94.5",
        "best of 3 selections",
        "60,000",
        "1:00 min",
        "episodes with 'grasped' that failed",
        "learning-rate",
        "--resume",
    ):
        assert expected in words, expected
    assert not page.open


def test_the_page_holds_all_that_it_shows(run):
    content = run[0].read_text()
    page = _Page(content)
    kinds = [address.split(";")[0] for address in page.addresses]
    assert kinds.count("data:video/mp4") == 1
    assert kinds.count("data:image/svg+xml") == 7
    assert set(kinds) == {"data:video/mp4", "data:image/svg+xml"}
    assert "default-src 'none'" in content
    assert not re.search(r"(https?:)?//(?!www\.w3\.org)[a-z]", re.sub(r'"data:[^"]*"', "", content))


def test_options_that_differ_from_the_default_stand_out(run):
    rows = re.findall(r'<tr class="changed"><th scope="row">([a-z-]+)<', run[0].read_text())
    assert rows == ["total-steps", "env", "reward"] or set(rows) == {"total-steps", "env"}


def test_a_page_is_written_again_to_the_same_bytes(run):
    path, config = run
    before = path.read_bytes()
    write_report(path.parent, config, [path.parent])
    assert path.read_bytes() == before


def test_the_page_of_a_run_that_still_trains_leaves_out_what_is_missing(tmp_path):
    folder = tmp_path / "run"
    config = make_run(folder, selections=(None,))
    (folder / "evaluation.json").unlink()
    content = write_report(folder, config, [folder]).read_text()
    assert "has not been evaluated yet" in content
    assert "<video" not in content
    assert "best of" not in content


def test_the_page_of_several_seeds_links_to_theirs(tmp_path):
    folder = tmp_path / "run"
    config = make_run(folder, (90, 70, 80), seed=4)
    content = write_report(folder, config, [folder / f"seed-{i}" for i in (4, 5, 6)]).read_text()
    for seed, rate in ((4, "90.0"), (5, "70.0"), (6, "80.0")):
        assert f'<a href="seed-{seed}/report.html">seed-{seed}</a></th><td>{rate} %</td>' in content


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"ci95": [0, 1], "episodes": "many"}'])
def test_a_damaged_evaluation_is_rejected(text, tmp_path):
    (tmp_path / "evaluation.json").write_text(text)
    with pytest.raises(ValueError, match=r"evaluation\.json is damaged: remove it"):
        read_evaluation(tmp_path)


@pytest.mark.parametrize(
    ("seconds", "text"), [(5, "0:05 min"), (3_599, "59:59 min"), (3_600, "1 h 00 min")]
)
def test_durations_are_said_in_their_unit(seconds, text):
    assert duration(seconds) == text


def test_text_cannot_become_a_tag():
    assert html.text("<img src=x onerror='f(\"\")'>") == (
        "&lt;img src=x onerror=&#x27;f(&quot;&quot;)&#x27;&gt;"
    )
