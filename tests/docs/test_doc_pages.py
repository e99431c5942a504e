from __future__ import annotations

import pathlib

import pytest
from doc_pages import NOTEBOOKS, PAGES, ROOT, commands, notebook_code, snippets, split_environment

from mjx_arm.physics.base import FIELDS
from mjx_arm.render.look import LOOK_FIELDS
from mjx_arm.varies import EXTRA_FIELDS

PAGE = """
Text.

<!-- test: slow -->
```python
x = 1
```

```{include} other.md
```

```sh
A=1 make train  # a comment
python a.py \\
  --b 2
for x in 1 2; do echo $x; done
```
"""


def test_snippets_have_their_line_language_and_mark():
    first, second = snippets(PAGE, "page.md")
    assert (first.language, first.text, first.mark, first.line) == ("python", "x = 1\n", "slow", 6)
    assert (second.language, second.mark) == ("sh", "")


def test_commands_of_a_shell_snippet():
    text = snippets(PAGE, "page.md")[1].text
    assert commands(text) == [
        ["A=1", "make", "train"],
        ["python", "a.py", "--b", "2"],
        ["echo", "$x"],
    ]
    assert split_environment(["A=1", "make", "train"]) == ({"A": "1"}, ["make", "train"])


def test_code_of_a_notebook_keeps_its_lines():
    text = "# Title\n```{code-cell}\nx = 1\n```\n```python\ny = 2\n```"
    assert notebook_code(text).splitlines()[2] == "x = 1"
    assert "y" not in notebook_code(text)


def test_pages_and_notebooks_are_found():
    assert len(PAGES) >= 25
    assert len(NOTEBOOKS) == 5


def test_every_language_of_the_pages_is_tested():
    """`text` is no code; `python`, `sh` and `json` are tried by test_snippets.py."""
    for path in PAGES:
        for each in snippets(path.read_text(), path.name):
            where = f"{path.name}, line {each.line}"
            assert each.language in ("python", "sh", "json", "text"), where
            assert each.mark in ("", "slow", "peers", "check", "devices"), where


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_what_is_marked_as_text_is_no_python(path: pathlib.Path):
    """Or no test would run it."""
    for each in snippets(path.read_text(), path.name):
        if each.language == "text":
            with pytest.raises(SyntaxError):
                compile(each.text, path.name, "exec")


def test_every_field_that_can_vary_is_on_the_page():
    page = (ROOT / "docs" / "tutorials" / "randomisation.md").read_text()
    for field in (*FIELDS, *LOOK_FIELDS, *EXTRA_FIELDS):
        assert f"`{field}`" in page, field


def test_every_agent_has_its_card_on_the_page():
    page = (ROOT / "docs" / "agents.md").read_text()
    cards = sorted((ROOT / "mjx_arm" / "agents").glob("*.md"))
    assert cards
    for card in cards:
        assert f"../mjx_arm/agents/{card.name}" in page


def test_every_example_is_in_a_page():
    pages = "".join(path.read_text() for path in PAGES)
    for example in (ROOT / "examples").glob("*.py"):
        assert f"examples/{example.name}\n" in pages, example.name


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 120
