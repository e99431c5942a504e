from __future__ import annotations

import pathlib

import pytest
from check_site import check_site, main


def write(site: pathlib.Path, **pages: str) -> pathlib.Path:
    for name, text in pages.items():
        (site / f"{name}.html").write_text(text)
    return site


def test_a_whole_site_has_no_problems(tmp_path: pathlib.Path):
    site = write(
        tmp_path,
        index='<h1 id="top">x</h1><a href="other.html#part">y</a><a href="https://a.org/b">z</a>',
        other='<h2 id="part">x</h2><a href="#part">y</a><img src="data:image/png;base64,AA">',
    )
    assert check_site(site) == []
    assert main(site) == 0


@pytest.mark.parametrize(
    ("page", "problem"),
    [
        ('<a href="missing.html">x</a>', "missing.html leads to no file"),
        ('<a href="#missing">x</a>', "#missing leads to no anchor"),
        ('<img src="missing.png">', "missing.png leads to no file"),
        ('<script src="https://cdn.org/x.js"></script>', "loads https://cdn.org/x.js from another"),
        ('<link rel="stylesheet" href="//fonts.org/f">', "loads //fonts.org/f from another host"),
    ],
)
def test_a_problem_is_named(page: str, problem: str, tmp_path: pathlib.Path):
    found = check_site(write(tmp_path, index=page))
    assert any(problem in each for each in found), found
    assert main(tmp_path) == 1


def test_a_style_that_loads_a_font_from_elsewhere_is_named(tmp_path: pathlib.Path):
    write(tmp_path, index="<p>x</p>")
    (tmp_path / "a.css").write_text("@font-face { src: url('https://fonts.org/f.woff2') }")
    assert check_site(tmp_path) == ["a.css loads https://fonts.org/f.woff2 from another host"]


def test_an_empty_folder_is_rejected(tmp_path: pathlib.Path):
    with pytest.raises(ValueError, match="must be a folder of HTML pages"):
        check_site(tmp_path)
