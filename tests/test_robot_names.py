"""Code is the same for all robots: what differs between them is in their descriptions and recipes."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
OWN = {"robots", "configs"}
"""Packages that may ask which robot they have."""


def lines_that_ask(code: str) -> list[int]:
    """Lines of Python in which something is compared with the name of a robot."""
    return [node.lineno for node in ast.walk(ast.parse(code)) if any(map(names_robot, compared_with(node)))]


def compared_with(node: ast.AST) -> list[ast.AST]:
    """What a piece of code compares."""
    if isinstance(node, ast.Compare):
        return [node.left, *node.comparators]
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and "with" in node.func.attr:
        return [*node.args]  # startswith, endswith
    return [node.value] if isinstance(node, ast.MatchValue) else []


def names_robot(value: ast.AST) -> bool:
    """Whether it is the name of a robot, or several in brackets with one among them."""
    parts = value.elts if isinstance(value, ast.Tuple | ast.List | ast.Set) else [value]
    return any(isinstance(part, ast.Constant) and part.value in ("h1", "g1") for part in parts)


def test_no_other_code_than_robots_and_recipes_asks_which_robot_it_has():
    """That a figure is of the paper's robot, or of the benchmark's, has a name."""
    files = [f for f in (*ROOT.glob("src/cotap/**/*.py"), *ROOT.glob("reports/**/*.py")) if not OWN & set(f.parts)]
    assert len(files) > 150
    assert [f"{f.relative_to(ROOT)}:{line}" for f in files for line in lines_that_ask(f.read_text())] == []


@pytest.mark.parametrize(
    "code",
    ["a.robot == 'h1'", "'g1' != x", "x in ('h1', 'g1')", "x not in {'g1'}", "match x:\n case 'h1': pass",
     "x.startswith('g1')"],
)  # fmt: skip
def test_that_question_is_found(code):
    assert lines_that_ask(code) == [code.count("\n") + 1]
    assert lines_that_ask("x = 'h1'\ny = x == ROBOT") == []
