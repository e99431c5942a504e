from __future__ import annotations

import pathlib
import sys

# The scripts of the documentation are no package.
sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "docs"))
