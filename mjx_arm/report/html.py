"""Pages of HTML in one file each: no page refers to another file, or to another host."""

from __future__ import annotations

import base64
import html
import pathlib
from collections.abc import Iterable, Sequence

_MIME = {".png": "image/png", ".svg": "image/svg+xml", ".mp4": "video/mp4", ".gif": "image/gif"}

# A browser that opens the page fetches nothing, whatever a name or an option in it holds.
_POLICY = "default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'"

_STYLE = """
:root { color-scheme: light dark; --ink: #1b1f24; --quiet: #59636e; --line: #d5dae0;
  --paper: #fff; --card: #f5f7f9; --accent: #0072b2; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e9ed; --quiet: #9da7b3; --line: #363d47;
  --paper: #14171b; --card: #1e2329; --accent: #56b4e9; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 76rem; padding: 1rem clamp(.8rem, 3vw, 2rem) 3rem;
  background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
h1 { font-size: 1.5rem; margin: .5rem 0 0; overflow-wrap: anywhere; }
h2 { font-size: 1.15rem; margin: 2.2rem 0 .7rem; }
h3 { font-size: 1rem; margin: 1.2rem 0 .3rem; }
p { margin: .3rem 0 .6rem; }
a { color: var(--accent); }
.quiet { color: var(--quiet); }
.cards { display: grid; gap: .7rem; grid-template-columns: repeat(auto-fit, minmax(10.5rem, 1fr));
  margin-top: 1rem; padding: 0; list-style: none; }
.cards li { background: var(--card); border: 1px solid var(--line); border-radius: .5rem;
  padding: .6rem .8rem; }
.cards strong { display: block; font-size: 1.35rem; }
.cards span { color: var(--quiet); font-size: .88rem; display: block; }
.curves { display: grid; gap: .7rem; grid-template-columns: repeat(auto-fit, minmax(17rem, 1fr)); }
.curves img { width: 100%; height: auto; background: #fff; border: 1px solid var(--line);
  border-radius: .5rem; }
video, .wide img { width: 100%; max-width: 48rem; height: auto; border-radius: .5rem; }
.scroll { overflow-x: auto; margin-bottom: .6rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: .3rem .9rem .3rem 0; border-bottom: 1px solid var(--line);
  vertical-align: top; }
.scroll:has(thead) :is(th, td) { white-space: nowrap; }
thead th { color: var(--quiet); font-weight: 600; font-size: .88rem; }
tbody th { font-weight: 400; }
.scroll:has(thead) tbody th { white-space: normal; min-width: 9rem; max-width: 18rem; }
tbody th code { white-space: nowrap; }
tr.changed th, tr.changed td { font-weight: 650; }
.groups { columns: 20rem; column-gap: 2.5rem; }
.groups section { break-inside: avoid; padding-top: .1rem; }
.groups table { width: 100%; }
td { overflow-wrap: anywhere; }
code, pre { font: .88rem/1.5 ui-monospace, "DejaVu Sans Mono", monospace; }
pre { background: var(--card); border: 1px solid var(--line); border-radius: .5rem;
  padding: .7rem .9rem; overflow-x: auto; margin: .4rem 0; }
figure { margin: .8rem 0 1rem; }
figure img { background: #fff; border-radius: .4rem; display: block; }
figure div { overflow-x: auto; }
.plot img { max-width: 100%; height: auto; }
@media (max-width: 48rem) { .plot img { max-width: none; } }
.strip img { max-width: none; }
figcaption { color: var(--quiet); font-size: .92rem; max-width: 52rem; margin-top: .3rem; }
.source { font-size: .85rem; overflow-wrap: anywhere; }
.missing { border-left: .25rem solid var(--accent); padding: .1rem 0 .1rem .9rem; margin: .8rem 0; }
details { margin: .4rem 0; }
details pre { max-height: 24rem; overflow: auto; }
footer { margin-top: 2.5rem; color: var(--quiet); font-size: .88rem; }
"""


def text(value: object) -> str:
    """A value as text that stands in HTML, in quotes or outside."""
    return html.escape(str(value), quote=True)


def data_uri(content: bytes, ending: str) -> str:
    """The address that holds a file's content itself.

    Args:
      content: of the file.
      ending: `.png`, `.svg`, `.mp4` or `.gif`.
    """
    return f"data:{_MIME[ending]};base64,{base64.b64encode(content).decode()}"


def document(title: str, parts: Iterable[str]) -> str:
    """A whole page; `parts` are pieces of HTML."""
    body = "\n".join(parts)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{text(title)}</title>\n<style>{_STYLE}</style>\n</head>\n"
        f"<body>\n{body}\n</body>\n</html>\n"
    )


def cards(items: Iterable[tuple[str, str, str]]) -> str:
    """Figures in large: of each its value, what it is, and a note, which may be empty."""
    made = []
    for value, name, note in items:
        small = f"<span>{text(note)}</span>" if note else ""
        made.append(f"<li><strong>{text(value)}</strong>{text(name)}{small}</li>")
    return f'<ul class="cards">{"".join(made)}</ul>'


def table(
    rows: Iterable[Sequence[str]], head: Sequence[str] = (), changed: Iterable[int] = ()
) -> str:
    """A table whose first column names the rows.

    Args:
      rows: cells, pieces of HTML.
      head: names of the columns, text; empty for none.
      changed: indices of rows that stand out.
    """
    bold = set(changed)
    lines = []
    for i, (first, *others) in enumerate(rows):
        cells = "".join(f"<td>{cell}</td>" for cell in others)
        kind = ' class="changed"' if i in bold else ""
        lines.append(f'<tr{kind}><th scope="row">{first}</th>{cells}</tr>')
    names = "".join(f'<th scope="col">{text(name)}</th>' for name in head)
    top = f"<thead><tr>{names}</tr></thead>" if head else ""
    return f'<div class="scroll"><table>{top}<tbody>{"".join(lines)}</tbody></table></div>'


def pictures(images: Iterable[tuple[str, bytes]]) -> str:
    """SVG pictures side by side; of each its title and content."""
    tags = [
        f'<img src="{data_uri(content, ".svg")}" alt="Curve: {text(title)}">'
        for title, content in images
    ]
    return f'<div class="curves">{"".join(tags)}</div>'


def commands(lines: Iterable[str]) -> str:
    """Command lines to copy."""
    return f"<pre>{text(chr(10).join(lines))}</pre>"


def write_page(path: pathlib.Path, page: str) -> None:
    """Writes a page: whole, or the one before stays."""
    part = path.with_name(f"{path.name}.part")
    try:
        part.write_text(page, encoding="utf-8")
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
