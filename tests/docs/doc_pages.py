"""Pages of the documentation, and the code in them."""

from __future__ import annotations

import dataclasses
import pathlib
import re
import shlex

ROOT = pathlib.Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.md"))
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted(
        path
        for path in (ROOT / "docs").rglob("*.md")
        if "_build" not in path.parts and path not in NOTEBOOKS
    ),
]
_FENCE = re.compile(r"^```(\S*)")
_MARK = re.compile(r"^<!-- test: (\w+) -->$")


@dataclasses.dataclass(frozen=True)
class Snippet:
    """A block of code in a page.

    Attributes:
      page: path of the page from the root of the repository.
      line: of its first line of code, from 1.
      language: that the page gives it, such as `python`.
      text: the code.
      mark: how it is tested, from a comment `<!-- test: MARK -->` above it; empty where there is
        none.
    """

    page: str
    line: int
    language: str
    text: str
    mark: str


def snippets(text: str, page: str) -> list[Snippet]:
    """The blocks of code of a page, without directives such as `{include}`."""
    found: list[Snippet] = []
    lines = text.splitlines()
    mark, start, language = "", None, ""
    for i, line in enumerate(lines):
        fence = _FENCE.match(line)
        if start is None and fence:
            start, language = i + 1, fence[1]
        elif start is not None and line == "```":
            if not language.startswith("{"):
                code = "\n".join(lines[start:i]) + "\n"
                found.append(Snippet(page, start + 1, language, code, mark))
            start, mark = None, ""
        elif start is None and line.strip():
            is_mark = _MARK.match(line)
            mark = is_mark[1] if is_mark else ""
    return found


def all_snippets(language: str) -> list[Snippet]:
    """The snippets of a language in all pages."""
    return [
        each
        for path in PAGES
        for each in snippets(path.read_text(), path.relative_to(ROOT).as_posix())
        if each.language == language
    ]


def commands(text: str) -> list[list[str]]:
    """The words of each command of a shell snippet; assignments before a command are kept."""
    joined = text.replace("\\\n", " ")
    lines = [shlex.split(line, comments=True) for line in joined.splitlines()]
    return [words for line in lines for words in _split(line) if words]


def _split(words: list[str]) -> list[list[str]]:
    """The commands of one line, without the words of a `for` loop."""
    found: list[list[str]] = [[]]
    for word in words:
        found[-1].append(word.removesuffix(";"))
        if word.endswith(";"):
            found.append([])
    found = [words[1:] if words[:1] == ["do"] else words for words in found]
    return [words for words in found if words[:1] not in (["for"], ["done"])]


def split_environment(words: list[str]) -> tuple[dict[str, str], list[str]]:
    """The assignments before a command, and its own words."""
    environment = {}
    while "=" in words[0] and not words[0].startswith("-"):
        name, _, value = words[0].partition("=")
        environment[name] = value
        words = words[1:]
    return environment, words


def notebook_code(text: str) -> str:
    """The code cells of a notebook as one program; its lines are those of the notebook."""
    code, inside = [], False
    for line in text.splitlines():
        if line == "```{code-cell}":
            inside = True
        elif line == "```":
            inside = False
        elif inside:
            code.append(line)
            continue
        code.append("")
    return "\n".join(code)
