from __future__ import annotations

import os
import pathlib

import pytest
from check_browser import check_pages, find_chromium, main

pytestmark = pytest.mark.slow
STYLE = '<meta name="viewport" content="width=device-width"><style>body { margin: 0 }</style>'


@pytest.fixture(autouse=True)
def chromium() -> None:
    """A missing browser fails where all is to be tested."""
    try:
        find_chromium()
    except ValueError as error:
        if os.environ.get("MJX_ARM_REQUIRE_BROWSER") == "1":
            raise
        pytest.skip(str(error))


def write(site: pathlib.Path, body: str) -> pathlib.Path:
    (site / "index.html").write_text(f"<!doctype html>{STYLE}<body>{body}</body>")
    return site


def test_a_good_page_has_no_problems(tmp_path: pathlib.Path):
    image = '<img src="data:image/gif;base64,R0lGODlhAQABAAAAACwAAAAAAQABAAA=">'
    wide = '<div style="overflow-x: auto"><div style="width: 2000px">x</div></div>'
    site = write(tmp_path, f'{image}{wide}<a href="https://example.org">x</a>')
    assert check_pages(site) == []
    assert main(site) == 0


def test_a_page_that_is_too_wide_for_a_phone_is_named(tmp_path: pathlib.Path):
    site = write(tmp_path, '<div style="width: 500px">x</div>')
    assert check_pages(site) == ["index.html, 390 pixels wide: the content is 500 pixels wide"]
    assert main(site) == 1


@pytest.mark.parametrize(
    ("body", "problem"),
    [
        ("<script>throw new Error('no such thing')</script>", "a script failed: no such thing"),
        (
            "<script>new Image().src = 'https://example.org/x'</script>",
            "it asks for https://example.org/x",
        ),
        ('<img src="//example.org/x.png">', "it asks for file://example.org/x.png"),
    ],
)
def test_an_error_and_a_request_are_named(body: str, problem: str, tmp_path: pathlib.Path):
    found = check_pages(write(tmp_path, body))
    assert found == [f"index.html, {width} pixels wide: {problem}" for width in (1280, 390)]


def test_an_empty_folder_is_rejected(tmp_path: pathlib.Path):
    with pytest.raises(ValueError, match="must be a folder of HTML pages"):
        check_pages(tmp_path)
