"""How Sphinx builds the documentation; `make docs` runs it."""

from __future__ import annotations

import pathlib
import re
import sys

HERE = pathlib.Path(__file__).parent
sys.path.insert(0, str(HERE))  # results.py

project = "mjx_arm"
author = copyright = "The mjx_arm authors"
package = (HERE.parent / "mjx_arm" / "__init__.py").read_text()
release = re.search(r'^__version__ = "(.*)"$', package, re.MULTILINE)[1]

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "results",
]
exclude_patterns = ["_build", "README.md"]

# The pages are Markdown. Headings get anchors, so that a link may name one.
myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3

# Notebooks are run when the documentation is built, and a cell that fails ends the build. Their
# outputs are kept in docs/_build until the notebook changes.
nb_execution_mode = "cache"
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_execution_cache_path = str(HERE / "_build" / "notebooks")
nb_merge_streams = True

# Docstrings write code between single backticks.
default_role = "code"

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_class_signature = "mixed"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
python_use_unqualified_type_names = True
add_module_names = False
maximum_signature_line_length = 80

# Code is copied without its prompt.
copybutton_prompt_text = "$ "

html_theme = "furo"
html_title = f"mjx_arm {release}"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_show_sphinx = False
html_copy_source = False
html_show_sourcelink = False
