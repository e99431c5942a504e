"""Imports go downward only; read from the syntax trees, relative and lazy imports included."""

from __future__ import annotations

import ast
import pathlib

import pytest

PACKAGE = pathlib.Path(__file__).parents[1] / "mjx_arm"

# Part of the package -> what it must not import. Each row holds for all that is in the part.
FORBIDDEN = {
    "options": ("config", "presets", "envs", "networks", "algos", "training", "report", "interop"),
    "varies": ("config", "presets", "envs", "networks", "algos", "training", "report", "interop"),
    "kinematics": (
        *("config", "presets", "envs", "networks", "algos", "training", "report", "interop"),
        *("scene", "physics", "render", "cli"),
    ),
    "physics": (
        *("config", "presets", "envs", "networks", "algos", "training", "report", "interop"),
        *("scene", "cli", "render"),
    ),
    "render": (
        *("config", "presets", "envs", "networks", "algos", "training", "report", "interop"),
        *("cli", "physics"),
    ),
    "scene": ("config", "presets", "envs", "networks", "algos", "training", "report", "interop"),
    "envs": ("config", "presets", "networks", "algos", "training", "report", "interop", "cli"),
    "config": ("presets", "networks", "algos", "training", "report", "interop", "cli"),
    "networks": ("presets", "envs", "algos", "training", "report", "interop", "cli"),
    "algos": ("presets", "networks", "training", "report", "interop", "cli"),
    "report": ("presets", "networks", "training", "interop", "cli"),
    "interop": ("config", "presets", "networks", "algos", "training", "report", "cli"),
    "training": ("interop", "cli", "presets"),
    "standin": (
        *("config", "presets", "networks", "algos", "training", "report", "interop"),
        *("cli", "export", "deploy"),
    ),
    "export": ("presets", "algos", "report", "interop", "cli", "standin", "deploy"),
    "deploy": (
        *("config", "presets", "networks", "algos", "training", "report", "interop"),
        *("cli", "export"),
    ),
    "tools": ("interop", "cli", "presets", "view", "deploy", "reproduce"),
    "view": ("interop", "cli", "presets", "tools", "reproduce"),
    "reproduce": ("interop", "cli", "view", "deploy", "standin"),
}
# Only the command line imports these.
OUTERMOST = ("tools", "view", "reproduce")
# No part of the training touches the stand-in for reality.
MAY_IMPORT_STANDIN = ("standin", "deploy", "tools", "cli")


def modules(part: str) -> list[pathlib.Path]:
    file = PACKAGE / f"{part}.py"
    return [file] if file.is_file() else sorted((PACKAGE / part).rglob("*.py"))


def imported(path: pathlib.Path, text: str | None = None) -> set[str]:
    """Full names of all that a module imports, at whatever depth of its code."""
    package = ["mjx_arm", *path.relative_to(PACKAGE).with_suffix("").parts][:-1]
    names = set()
    for node in ast.walk(ast.parse(path.read_text() if text is None else text)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) + 1 - node.level] if node.level else []
            source = ".".join([*base, *([node.module] if node.module else [])])
            names |= {f"{source}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Call) and node.args:
            function = ast.unparse(node.func)
            if function in ("import_module", "importlib.import_module", "__import__"):
                names |= {ast.unparse(node.args[0]).strip("'\"")}
    return names


def parts_of(names: set[str]) -> set[str]:
    """Parts of the package among imported names; the package itself counts as `*`."""
    ours = [name.split(".") for name in names if name.split(".")[0] == "mjx_arm"]
    known = {path.stem for path in PACKAGE.iterdir()}
    return {(name[1:2] or ["*"])[0] if (name[1:2] or ["*"])[0] in known else "*" for name in ours}


@pytest.mark.parametrize("part", FORBIDDEN)
def test_imports_go_downward(part):
    paths = modules(part)
    assert paths
    for path in paths:
        found = parts_of(imported(path))
        # `from mjx_arm import ...` is everything at once.
        assert "*" not in found, path
        assert not found & set(FORBIDDEN[part]), path


def test_only_the_command_line_imports_the_tools():
    for path in sorted(PACKAGE.rglob("*.py")):
        if path.relative_to(PACKAGE).parts[0] not in ("cli", *OUTERMOST):
            assert not parts_of(imported(path)) & set(OUTERMOST), path


def test_nothing_that_trains_imports_the_stand_in():
    for path in sorted(PACKAGE.rglob("*.py")):
        part = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        if part not in MAY_IMPORT_STANDIN:
            assert "standin" not in parts_of(imported(path)), path


def test_every_part_of_the_package_is_in_the_table():
    outer = {"__init__", "__main__", "arguments", "cli", "presets"}
    helpers = {"cores", "devices", "digest", "microbatch", "policy", "references"}
    helpers |= {"shard", "silence"}
    names = {path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or path.is_dir()}
    found = {name for name in names if modules(name)}
    assert found - {"xml", "__pycache__"} == set(FORBIDDEN) | outer | helpers
    for name in helpers:
        assert parts_of(imported(PACKAGE / f"{name}.py")) == set()


@pytest.mark.parametrize(
    ("line", "part"),
    [
        ("import mjx_arm.envs.env", "envs"),
        ("from mjx_arm import envs", "envs"),
        ("from mjx_arm.envs.env import Env", "envs"),
        ("from ..envs import env", "envs"),
        ("from .. import envs", "envs"),
        ("def f():\n    from ..envs.env import Env", "envs"),
        ("if TYPE_CHECKING:\n    import mjx_arm.envs", "envs"),
        ("importlib.import_module('mjx_arm.envs')", "envs"),
        ("import mjx_arm", "*"),
        ("from mjx_arm import make", "*"),
    ],
)
def test_every_kind_of_import_is_seen(line, part):
    assert parts_of(imported(PACKAGE / "physics" / "mjx.py", line)) == {part}
