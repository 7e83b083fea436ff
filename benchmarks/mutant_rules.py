"""Which mutants of a module there are: what cosmic-ray makes, less what says nothing about tests.

Left out are places without effect (`mutant_spans`), and operators that only flatter: a shift or a bitwise operator in
place of arithmetic raises on every tensor of floats, `~` in place of a sign raises on floats, and whether `is` answers
as `==` does depends on which objects the interpreter shares.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names

from benchmarks.mutant_spans import spans_without_effect

ARITHMETIC = {"Add", "Sub", "Mul", "Div", "FloorDiv", "Mod", "Pow"}
BITWISE = {"BitOr", "BitAnd", "BitXor"}
ORDER = {"Eq", "NotEq", "Lt", "LtE", "Gt", "GtE"}
IDENTITY = {"Is", "IsNot"}
DELETED = {"Delete"}
GROUPS = (ARITHMETIC, BITWISE, ORDER, IDENTITY)


@dataclass(frozen=True)
class Mutant:
    """One change of one place in one file."""

    file: str
    """Relative to the root of the repository."""
    line: int
    column: int
    operator: str
    """As cosmic-ray names it."""
    occurrence: int
    """Which of the operator's places in the file it changes."""

    def source(self, original: str) -> str:
        """The whole file as the mutant has it. Raises ValueError if `original` has no such place."""
        changed = mutate_code(original, get_operator(f"core/{self.operator}")(), self.occurrence)
        if changed is None:
            raise ValueError(f"{self.file} has no occurrence {self.occurrence} for {self.operator}: it has changed")
        return changed

    def change(self, original: str) -> tuple[str, str]:
        """The first line that differs, as it is and as the mutant has it (empty if removed), not indented."""
        before, after = ([x for x in text.splitlines() if x.strip()] for text in (original, self.source(original)))
        at = next((i for i, (a, b) in enumerate(zip(before, after, strict=False)) if a != b), len(after))
        return before[at].strip(), "" if len(after) < len(before) else after[at].strip()


def mutants_of(root: Path, file: str) -> Iterator[Mutant]:
    """Every mutant of `file`, relative to `root`, that no rule leaves out."""
    source = (root / file).read_text(encoding="utf-8")
    left_out, nodes = spans_without_effect(source), list(ast_nodes(get_ast(source)))
    for name in filter(_says_something, operator_names()):
        operator = get_operator(name)()
        starts = [start for node in nodes for start, _ in operator.mutation_positions(node)]
        for occurrence, (line, column) in enumerate(starts):
            if not any(begin <= (line, column) < end for begin, end in left_out):
                yield Mutant(file, line, column, name.removeprefix("core/"), occurrence)


def _says_something(name: str) -> bool:
    """Whether an operator can do more than raise, and needs no arguments."""
    if get_operator(name).arguments():
        return False
    kind, _, change = name.removeprefix("core/").partition("_")
    if not kind.startswith("Replace") or not change:
        return True
    old, new = change.split("_")
    return old in DELETED or any(old in group and new in group for group in GROUPS)
