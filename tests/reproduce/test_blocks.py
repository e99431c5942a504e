"""The page as HTML and as Markdown."""

from __future__ import annotations

from mjx_arm.reproduce.blocks import (
    Command,
    Fold,
    Heading,
    Missing,
    Picture,
    Source,
    Table,
    Text,
    to_html,
    to_markdown,
)

BLOCKS = [
    Heading("One & all", 1),
    Text("Some `code` and <b>."),
    Table(("a", "b"), (("x | y", "1"),)),
    Picture("plot.svg", b"<svg/>", 'A "plot"', "Below it.", wide=True),
    Source(("cells/one.json", "cells/two.json")),
    Missing("It is missing.", "mjx-arm reproduce --only one"),
    Command(("mjx-arm --help",)),
    Fold("Options", '{"a": 1}'),
]


def test_html_holds_its_images_and_escapes_text():
    page = to_html("Title", BLOCKS)
    assert "<h1>One &amp; all</h1>" in page
    assert "<p>Some <code>code</code> and &lt;b&gt;.</p>" in page
    assert 'src="data:image/svg+xml;base64,PHN2Zy8+" alt="A &quot;plot&quot;"' in page
    assert "Files: <code>cells/one.json</code>, <code>cells/two.json</code>." in page
    assert "mjx-arm reproduce --only one" in page
    assert "default-src 'none'" in page


def test_markdown_says_the_same():
    text = to_markdown(BLOCKS, "pictures")
    for line in (
        "# One & all",
        "| a | b |\n| --- | --- |\n| x \\| y | 1 |",
        '![A "plot"](pictures/plot.svg)',
        "*Below it.*",
        "**Missing.** It is missing.",
        "*Files: `cells/one.json`, `cells/two.json`.*",
    ):
        assert line in text
