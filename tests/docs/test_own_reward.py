"""A reward of one's own trains in under 30 lines, by nothing but what the package exports."""

from __future__ import annotations

import ast

import pytest
from doc_pages import ROOT, all_snippets

import mjx_arm

PAGE = "docs/tutorials/own-reward.md"


def code_lines(text: str, nodes: list[ast.stmt]) -> list[str]:
    """The lines of some statements as they are written, without docstrings and comments."""
    found = []
    for node in nodes:
        lines = range(node.lineno, node.end_lineno + 1)
        if isinstance(node, ast.FunctionDef) and ast.get_docstring(node) is not None:
            docstring = node.body[0]
            lines = [i for i in lines if not docstring.lineno <= i <= docstring.end_lineno]
        found += [text.splitlines()[i - 1] for i in lines]
    return [line for line in found if line.strip() and not line.strip().startswith("#")]


def private_names(text: str) -> set[str]:
    """What a program uses of the package that is not in `mjx_arm.__all__`."""
    exported, found = set(mjx_arm.__all__), set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "mjx_arm":
            names = {alias.name for alias in node.names}
            found |= names - exported if node.module == "mjx_arm" else names
        elif isinstance(node, ast.Import):
            found |= {x.name for x in node.names if x.name.startswith("mjx_arm.")}
        elif isinstance(node, ast.Attribute):
            if node.attr.startswith("_"):
                found.add(node.attr)
            if ast.unparse(node.value) == "mjx_arm":
                found |= {node.attr} - exported
    return found


def reward_and_training() -> tuple[str, str]:
    """The example and the snippet that trains with it."""
    (snippet,) = [each for each in all_snippets("python") if each.page == PAGE]
    return (ROOT / "examples" / "own_reward.py").read_text(), snippet.text


def test_a_reward_that_trains_has_under_30_lines():
    """The imports and the function of the example, and the snippet; an import counts once."""
    example, snippet = reward_and_training()
    kept = [
        node
        for node in ast.parse(example).body
        if isinstance(node, ast.Import | ast.ImportFrom)
        or (isinstance(node, ast.FunctionDef) and node.name == "reward")
    ]
    lines = code_lines(example, kept)
    assert "def reward(" in lines
    assert any("success" in line for line in lines)
    more = code_lines(snippet, ast.parse(snippet).body)
    assert more[-1].startswith("mjx_arm.train(")
    assert len(lines + [line for line in more if line not in lines]) < 30


def test_it_uses_no_private_name():
    example, snippet = reward_and_training()
    assert private_names(example) | private_names(snippet) == set()


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("import mjx_arm\nmjx_arm.scene.load_scene('arm_cube')", "scene"),
        ("from mjx_arm.envs.env import Env", "Env"),
        ("from mjx_arm import make, config", "config"),
        ("import mjx_arm.envs", "mjx_arm.envs"),
        ("x._digest(1)", "_digest"),
    ],
)
def test_a_private_name_is_found(text: str, name: str):
    assert private_names(text) == {name}
