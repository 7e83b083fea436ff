"""Places of a module where a change cannot change behaviour, by rule.

Annotations that nothing evaluates, blocks for type checkers, texts of errors, guards that fire on mistakes of
programmers alone (`frozen`, `slots` and `kw_only` of dataclasses, `strict=True` of `zip`), and caches.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator

Position = tuple[int, int]
Span = tuple[Position, Position]

GUARDS = {"frozen", "slots", "kw_only"}
CACHES = {"cache", "lru_cache"}


def spans_without_effect(source: str) -> list[Span]:
    """Where a change does not count, as ((line, column), (line, column)) from 1 and from 0; the end is not in it."""
    tree, lines = ast.parse(source), source.splitlines()
    lazy = any(isinstance(n, ast.ImportFrom) and n.module == "__future__" for n in tree.body)
    found = [part for node in ast.walk(tree) for part in _without_effect(node, lazy)]

    def characters(line: int, utf8: int) -> Position:
        return line, len(lines[line - 1].encode()[:utf8].decode())

    return [
        (characters(n.lineno, n.col_offset), characters(n.end_lineno or 0, n.end_col_offset or 0)) for n in found
    ] + _cache_lines(tree)


def _without_effect(node: ast.AST, lazy_annotations: bool) -> Iterator[ast.expr | ast.stmt]:
    """Parts of one node that no rule lets count."""
    if lazy_annotations:
        if isinstance(node, (ast.arg, ast.AnnAssign)) and node.annotation:
            yield node.annotation
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) and node.returns:
            yield node.returns
    if isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "__name__ == '__main__'"):
        yield node
    if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
        yield from (a for a in ast.walk(node.exc) if isinstance(a, ast.JoinedStr))
    if isinstance(node, ast.Call):
        name = ast.unparse(node.func)
        yield from (k.value for k in node.keywords if name == "dataclass" and k.arg in GUARDS)
        yield from (k.value for k in node.keywords if name == "zip" and k.arg == "strict")


def _cache_lines(tree: ast.Module) -> list[Span]:
    """Decorators that only save time."""
    decorators = [d for n in ast.walk(tree) if isinstance(n, ast.FunctionDef) for d in n.decorator_list]
    caches = [d for d in decorators if ast.unparse(d).split("(")[0].removeprefix("functools.") in CACHES]
    return [((d.lineno, 0), (d.lineno + 1, 0)) for d in caches]
