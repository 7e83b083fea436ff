"""What `make mutants` leaves out, and that it leaves out no other; files and lines that it names."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.mutant_rooms import ROOMS
from benchmarks.mutant_spans import spans_without_effect

ROOT = Path(__file__).parents[1]
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


@pytest.mark.parametrize("room", ["compliance", "deployment"])
def test_a_room_has_all_its_files(room):
    files = [path for path in (ROOT / "src/cotap" / room).glob("*.py") if len(path.read_text().splitlines()) > 1]
    assert set(ROOMS[room]) == {path.relative_to(ROOT).as_posix() for path in files}


def test_tests_of_a_room_exist():
    for test in {test for room in ROOMS.values() for tests in room.values() for test in tests}:
        file, _, function = test.partition("::")
        assert f"def {function}" in (ROOT / file).read_text(encoding="utf-8")


def test_lines_that_may_change_are_there():
    """Each with a reason; a line that has changed must be judged anew."""
    for entry in json.loads((ROOT / "benchmarks/equivalent_mutants.json").read_text(encoding="utf-8")):
        lines = [line.strip() for line in (ROOT / entry["file"]).read_text(encoding="utf-8").splitlines()]
        assert entry["code"] in lines
        assert entry["code"] not in entry["mutants"]
        assert entry["reason"]
