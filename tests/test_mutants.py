"""Which places of a module `make mutants` leaves out, and that it leaves out no other."""

from __future__ import annotations

import pytest

from benchmarks.mutant_spans import spans_without_effect

MODULE = """
from __future__ import annotations

@dataclass(frozen=True)
class Pair:
    é: int | None = 1 + 1

@functools.lru_cache(maxsize=3)
def f(x: int | None, y=2 * 3) -> int | str:
    if TYPE_CHECKING:
        y = 4
    if x > 5:
        raise SystemExit(6 if y else f"é {x + 7}")
    return [a for a, b in zip("é", y, strict=True)]
"""
LEFT_OUT = ["frozen=^True", "é: ^int | None = 1 + 1", "x: ^int", "-> ^int | str", "y = ^4", 'é {x + ^7', "maxsize=^3",
            "strict=^True"]  # fmt: skip
COUNTED = ["None = ^1 + 1", "y=^2 * 3", "x ^> 5", "SystemExit(^6", "^@dataclass", 'zip("é", ^y', "é: int | None = 1 ^+"]


def is_left_out(place: str) -> bool:
    before, _, after = place.partition("^")
    start = MODULE.index(before + after) + len(before)
    line, column = MODULE.count("\n", 0, start) + 1, start - MODULE.rfind("\n", 0, start) - 1
    return any(begin <= (line, column) < end for begin, end in spans_without_effect(MODULE))


@pytest.mark.parametrize("place", LEFT_OUT)
def test_what_changes_nothing_is_left_out(place):
    assert is_left_out(place)


@pytest.mark.parametrize("place", COUNTED)
def test_what_changes_something_counts(place):
    assert not is_left_out(place)


def test_annotations_count_where_python_evaluates_them():
    assert spans_without_effect("x: int = 1") == []
