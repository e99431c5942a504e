"""The page of the shipped agents in the repository is the one that its files make."""

from __future__ import annotations

import json
import pathlib
import re
import shutil

import pytest

from mjx_arm.cli import main

ROOT = pathlib.Path(__file__).parents[2]
PAGE = pathlib.Path("benchmarks/results/reproduce")
# As the files in its folder say: `mjx-arm reproduce --only CELL ...`.
CELL = json.loads((ROOT / PAGE / "cells" / "figure1-arm_cube.json").read_text())
ARGUMENTS = CELL["command"].split()[4:]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The same files in a folder of the same name, and the page made of them again."""
    root = tmp_path_factory.mktemp("repository")
    (root / PAGE).parent.mkdir(parents=True)
    for name in ("agent-a", "agent-b"):
        (root / PAGE.parent / name).symlink_to(ROOT / PAGE.parent / name)
    for name in ("cells", "pictures"):
        shutil.copytree(ROOT / PAGE / name, root / PAGE / name)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        assert main(["reproduce", *ARGUMENTS, "--only", "page"]) == 0
    return root / PAGE


def test_it_is_made_of_its_files(made):
    assert (made / "index.md").read_text() == (ROOT / PAGE / "index.md").read_text()


def test_it_is_one_small_file_whose_images_have_texts(made):
    page = (made / "index.html").read_text()
    assert len(page) < 10_000_000
    images = re.findall(r"<img [^>]*>", page)
    assert len(images) > 10
    assert all(re.fullmatch(r'<img src="data:[^"]+" alt="[^"]{10,}">', x) for x in images)
    bare = re.sub(r'"data:[^"]*"', "", page)
    assert "://" not in bare


def test_every_cell_names_its_command(made):
    cells = sorted((made / "cells").glob("*.json"))
    assert cells
    page = (made / "index.md").read_text()
    for path in cells:
        if path.name.startswith("cell-"):
            continue  # of `transfer.json`, which has them all
        assert f"`cells/{path.name}`" in page
        if path.stem not in ("figure5", "transfer"):  # by benchmarks
            cell = json.loads(path.read_text())
            command = ["mjx-arm", "reproduce", "--only", cell["name"], *ARGUMENTS]
            assert cell["command"] == " ".join(command)
