"""The notebooks run from their first cell to their last, in a process of their own."""

from __future__ import annotations

import pathlib
import re
import subprocess
import sys

import pytest
from doc_pages import NOTEBOOKS, notebook_code

# A warning is an error. Plots go nowhere.
RUN = [sys.executable, "-W", "error", "-"]


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path: pathlib.Path, tmp_path: pathlib.Path):
    code = f"import matplotlib\nmatplotlib.use('agg')\n{notebook_code(path.read_text())}"
    done = subprocess.run(
        RUN, input=code, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_trains_for_at_most_2000_steps(path: pathlib.Path):
    code = notebook_code(path.read_text())
    steps = re.findall(r"(?:total_steps=|STEPS = )([\d_]+)", code)
    assert all(int(each) <= 2_000 for each in steps)
    assert "train_config" not in code or steps
