"""Opens each page of the built documentation in Chromium, as wide as a desktop and as a phone.

    python docs/check_browser.py docs/_build/html

No page may be wider than its window, run into an error of a script, or ask another host for
anything. It needs playwright and the system's Chromium.
"""

from __future__ import annotations

import pathlib
import shutil
import sys
import urllib.parse
from collections.abc import Iterator
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome")
WIDTHS = (1280, 390)
_HEIGHT = 900
_ARGUMENTS = [
    "--no-sandbox",
    "--disable-background-networking",
    "--host-resolver-rules=MAP * ~NOTFOUND",
]
# What a page may load: files beside it, and what it contains or makes itself.
_OWN = ("file", "data", "blob")


def find_chromium() -> str:
    """Path of the browser.

    Raises:
      ValueError: there is none.
    """
    found = next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        raise ValueError(f"a browser is needed, one of {', '.join(NAMES)}: install chromium")
    return found


def check_pages(site: pathlib.Path) -> list[str]:
    """Sentences about what is wrong with the pages in a folder; empty if nothing is.

    Raises:
      ValueError: the folder has no page, or there is no browser.
    """
    from playwright.sync_api import sync_playwright

    pages = sorted(site.resolve().rglob("*.html"))
    if not pages:
        raise ValueError(f"{site} must be a folder of HTML pages, and it has none: run make docs")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=find_chromium(), args=_ARGUMENTS)
        found = []
        for width in WIDTHS:
            for path in pages:
                where = f"{path.relative_to(site.resolve())}, {width} pixels wide"
                page = browser.new_page(viewport={"width": width, "height": _HEIGHT})
                found += [f"{where}: {problem}" for problem in _problems(page, path)]
                page.close()
        browser.close()
    return found


def _problems(page: Any, path: pathlib.Path) -> Iterator[str]:
    asked: list[str] = []
    errors: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(path.as_uri(), wait_until="load")
    width, inner = page.evaluate("[document.documentElement.scrollWidth, window.innerWidth]")
    if width > inner:
        yield f"the content is {width} pixels wide"
    for error in errors:
        yield f"a script failed: {error}"
    for address in dict.fromkeys(asked):
        parts = urllib.parse.urlsplit(address)
        if parts.scheme not in _OWN or (parts.scheme == "file" and parts.netloc):
            yield f"it asks for {address}"


def main(site: pathlib.Path) -> int:
    """Prints what is wrong; the exit status is 1 if anything is."""
    found = check_pages(site)
    for sentence in found:
        print(sentence, file=sys.stderr)
    print(f"{site}: {len(found)} problems in the browser")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(pathlib.Path(sys.argv[1])))
