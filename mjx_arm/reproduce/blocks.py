"""The parts that a page is made of, and the page as HTML and as Markdown."""

from __future__ import annotations

import dataclasses
import pathlib
import re
from collections.abc import Iterable, Iterator, Sequence

from mjx_arm.report import html


@dataclasses.dataclass(frozen=True)
class Heading:
    """A heading; `level` 1 is the page's own."""

    text: str
    level: int = 2


@dataclasses.dataclass(frozen=True)
class Text:
    """A paragraph; `code` stands between backticks, as in Markdown."""

    text: str


@dataclasses.dataclass(frozen=True)
class Source:
    """The files that the figures above are from."""

    files: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Missing:
    """A part that is not measured yet: what, and the command that fills it."""

    text: str
    command: str


@dataclasses.dataclass(frozen=True)
class Table:
    """A table; its first column names the rows."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclasses.dataclass(frozen=True)
class Picture:
    """A picture.

    Attributes:
      name: of its file.
      content: of the file.
      alt: what it shows, for those who do not see it.
      caption: below it; empty for none.
      wide: it does not shrink on a small screen, but scrolls.
    """

    name: str
    content: bytes
    alt: str
    caption: str = ""
    wide: bool = False


@dataclasses.dataclass(frozen=True)
class Command:
    """Command lines to copy."""

    lines: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Fold:
    """Long text that is shown when asked for."""

    title: str
    text: str


Block = Heading | Text | Source | Missing | Table | Picture | Command | Fold


def to_html(title: str, blocks: Iterable[Block]) -> str:
    """A page in one file, whose images are part of it."""
    return html.document(title, (part for block in blocks for part in _html(block)))


def _html(block: Block) -> Iterator[str]:
    match block:
        case Heading(text, level):
            yield f"<h{level}>{_inline(text)}</h{level}>"
        case Text(text):
            yield f"<p>{_inline(text)}</p>"
        case Source(files):
            yield f'<p class="quiet source">{_inline(_files(files))}</p>'
        case Missing(text, command):
            yield f'<div class="missing"><p>{_inline(text)}</p>{html.commands([command])}</div>'
        case Table(head, rows):
            yield html.table([[_inline(cell) for cell in row] for row in rows], head)
        case Picture(name, content, alt, caption, wide):
            uri = html.data_uri(content, pathlib.PurePath(name).suffix)
            kind = "strip" if wide else "plot"
            below = f"<figcaption>{_inline(caption)}</figcaption>" if caption else ""
            image = f'<img src="{uri}" alt="{html.text(alt)}">'
            yield f'<figure class="{kind}"><div>{image}</div>{below}</figure>'
        case Command(lines):
            yield html.commands(lines)
        case Fold(title, text):
            inside = f"<pre>{html.text(text)}</pre>"
            yield f"<details><summary>{_inline(title)}</summary>{inside}</details>"


def _inline(text: str) -> str:
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", html.text(text))


def _files(files: Sequence[str]) -> str:
    plural = "s" if len(files) > 1 else ""
    return f"File{plural}: {', '.join(f'`{file}`' for file in files)}."


def to_markdown(blocks: Iterable[Block], pictures: str) -> str:
    """The same page as Markdown.

    Args:
      blocks: of the page.
      pictures: the folder of its pictures, relative to it.
    """
    return "\n".join(line for block in blocks for line in (*_markdown(block, pictures), ""))


def _markdown(block: Block, pictures: str) -> Iterator[str]:
    match block:
        case Heading(text, level):
            yield f"{'#' * level} {text}"
        case Text(text):
            yield text
        case Source(files):
            yield f"*{_files(files)}*"
        case Missing(text, command):
            yield from (f"**Missing.** {text}", "", "```text", command, "```")
        case Table(head, rows):
            yield _row(head)
            yield _row(["---"] * len(head))
            yield from map(_row, rows)
        case Picture(name, _, alt, caption, _):
            yield f"![{alt}]({pictures}/{name})"
            if caption:
                yield from ("", f"*{caption}*")
        case Command(lines):
            yield from ("```text", *lines, "```")
        case Fold(title, text):
            yield from (f"<details><summary>{title}</summary>", "", "```text", text, "```", "")
            yield "</details>"


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"
