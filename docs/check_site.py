"""Checks the built documentation: every link inside it leads somewhere, and it opens offline.

    python docs/check_site.py docs/_build/html

A page may link to other hosts, but must not load a script, a style, a picture or a font from one.
"""

from __future__ import annotations

import html.parser
import pathlib
import re
import sys
import urllib.parse

# Tags whose address is loaded when the page opens.
_LOADED = {"img": "src", "script": "src", "source": "src", "iframe": "src", "video": "src"}
_STYLE_URL = re.compile(r"url\(\s*['\"]?([^'\")]+)|@import\s+['\"]([^'\"]+)")


class Page(html.parser.HTMLParser):
    """What one page links to, what it loads, and which anchors it has."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Notes the addresses and the anchors of a tag."""
        values = {name: value or "" for name, value in attrs}
        self.anchors |= {values[name] for name in ("id", "name") if name in values}
        if tag == "a" and "href" in values:
            self.links.append(values["href"])
        elif tag == "link" and "href" in values:
            # A canonical address is a name and is not loaded.
            (self.links if values.get("rel") == "canonical" else self.loads).append(values["href"])
        elif tag in _LOADED and values.get(_LOADED[tag]):
            self.loads.append(values[_LOADED[tag]])


def check_site(site: pathlib.Path) -> list[str]:
    """Sentences about what is wrong with the pages in a folder; empty where nothing is.

    Raises:
      ValueError: the folder has no page.
    """
    pages = {path: Page(path.read_text(encoding="utf-8")) for path in sorted(site.rglob("*.html"))}
    if not pages:
        raise ValueError(f"{site} must be a folder of HTML pages, and it has none: run make docs")
    found = []
    for path, page in pages.items():
        name = path.relative_to(site)
        for address in page.loads:
            if _is_elsewhere(address):
                found.append(f"{name} loads {address} from another host")
        found += [f"{name}: {x}" for x in _broken(path, page.links + page.loads, pages)]
    for path in sorted(site.rglob("*.css")):
        for match in _STYLE_URL.finditer(path.read_text(encoding="utf-8")):
            address = match[1] or match[2]
            if _is_elsewhere(address):
                found.append(f"{path.relative_to(site)} loads {address} from another host")
    return found


def _is_elsewhere(address: str) -> bool:
    return bool(urllib.parse.urlsplit(address).netloc)


def _broken(path: pathlib.Path, addresses: list[str], pages: dict[pathlib.Path, Page]) -> list[str]:
    """The links of a page that lead to no file, or to an anchor that its page does not have."""
    found = []
    for address in dict.fromkeys(addresses):
        parts = urllib.parse.urlsplit(address)
        if parts.scheme or parts.netloc:
            continue
        target = path
        if parts.path:
            target = (path.parent / urllib.parse.unquote(parts.path)).resolve()
        if not target.is_file():
            found.append(f"{address} leads to no file")
            continue
        anchor = urllib.parse.unquote(parts.fragment)
        if anchor and target in pages and anchor not in pages[target].anchors:
            found.append(f"{address} leads to no anchor")
    return found


def main(site: pathlib.Path) -> int:
    """Prints what is wrong; the exit status is 1 if anything is."""
    found = check_site(site.resolve())
    for sentence in found:
        print(sentence, file=sys.stderr)
    print(f"{site}: {len(found)} problems with links and loaded files")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(pathlib.Path(sys.argv[1])))
