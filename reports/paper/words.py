"""Results in words: numbers with their intervals, differences between two rows, and verdicts on claims."""

from __future__ import annotations

from typing import Any

from reports.paper.book import Book
from reports.paper.tables import PAPER_ROBOT

NOT_MEASURED = "(not measured)"
LABELS = {
    "e_torso": "e_torso [m/s]",
    "e_ee": "e_ee [m]",
    "e_ee_hit": "e_ee of the hand that is hit [m]",
    "j_upper": "J_upper [Nm]",
    "j_upper_push": "J_upper, first 0.1 s [Nm]",
}
"""Measures of an impact, with their units."""
DIGITS = {"j_upper": 1, "j_upper_push": 1}
"""Digits of a measure, where they are not three."""
ALL_THREE = ("e_torso", "e_ee", "j_upper")
"""The measures of the paper's Table III."""


def number(m: dict[str, Any] | None, digits: int = 3) -> str:
    """A measure as mean and the larger half of its interval."""
    if m is None:
        return NOT_MEASURED
    if m["mean"] is None:
        return f"({m['reason']})"
    if m["ci95"] is None:
        return f"{m['mean']:.{digits}f} ({m['reason']})"
    return f"{m['mean']:.{digits}f}{_half(m['mean'], m['ci95'], digits)}"


def _half(mean: float, interval: list[float], digits: int) -> str:
    return f"±{max(mean - interval[0], interval[1] - mean):.{digits}f}"


def share(events: int, of_all: int) -> str:
    """A share [%] with Wilson's interval, whose halves differ."""
    from cotap.evaluation.metrics import wilson_interval

    low, high = wilson_interval(events / of_all, of_all)
    return f"{100.0 * events / of_all:.1f} [{100.0 * low:.1f},{100.0 * high:.1f}]"


def hundredfold(m: dict[str, Any] | None, digits: int = 1) -> str:
    """A share in percent, or a length in centimetres, with its interval."""
    if m is None or m["mean"] is None:
        return number(m)
    bounds = m["ci95"] and [100.0 * bound for bound in m["ci95"]]
    return number(m | {"mean": 100.0 * m["mean"], "ci95": bounds}, digits)


def fallen(result: dict[str, Any]) -> str:
    """Share of envs that fell by the end of the episode [%], with Wilson's interval."""
    return share(result["num_falls"], result["num_envs"])


def missing(policy: str) -> str:
    """What stands where a policy would be measured of which there is no checkpoint."""
    return f"no checkpoint of `{policy}`: not measured"


def printed(numbers: tuple[float, ...] | None) -> str:
    """Numbers of the paper in one cell."""
    return "-" if numbers is None else " / ".join(f"{value:g}" for value in numbers)


def the_paper(book: Book) -> str:
    """How a sentence begins that says what the paper measured."""
    return "The paper" if book.robot == PAPER_ROBOT else f"The paper, whose robot is {PAPER_ROBOT.upper()},"


def of(book: Book, name: str, measure: str, digits: int = 3) -> str:
    """The mean of a measure over the envs that stood in a row."""
    result = book.results.get(name)
    mean = result["metrics_without_falls"].get(measure, {}).get("mean") if result else None
    return NOT_MEASURED if mean is None else f"{mean:.{digits}f}"


def fell(book: Book, name: str) -> str:
    """The share that fell in a row [%]."""
    return fallen(book.results[name]) if name in book.results else NOT_MEASURED


def compared(book: Book, first: str, second: str, measure: str) -> dict[str, Any]:
    """The second row less the first, over the envs that stood in both; `difference` is null where there is none."""
    from cotap.compare import measure_difference

    if not {first, second} <= book.results.keys():
        return {"difference": None, "reason": "not measured"}
    d = measure_difference(book.results[first], book.results[second], measure, without_falls=True)
    book.differences[f"{measure}: {second} - {first}"] = d
    return d


def change(book: Book, first: str, second: str, measure: str, digits: int = 3) -> str:
    """The second row less the first, and the larger half of the interval."""
    d = compared(book, first, second, measure)
    if d["difference"] is None:
        return f"({d['reason']})"
    return f"{d['difference']:+.{digits}f}{_half(d['difference'], d['ci95'], digits)}"


def verdict(book: Book, smaller: str, larger: str, measure: str, digits: int = 3) -> str:
    """Whether a measure is larger in one row than in another, as the interval of the difference has it."""
    d = compared(book, smaller, larger, measure)
    if d["difference"] is None:
        return f"({d['reason']})"
    low, high = d["ci95"]
    word = "holds" if low > 0.0 else "does not hold" if high < 0.0 else "cannot be distinguished"
    return f"**{word}**, {change(book, smaller, larger, measure, digits)}"


def outcome(d: dict[str, Any]) -> str:
    """What a difference of a measure of which less is better means, by its interval."""
    low, high = d["ci95"]
    return "better" if high < 0.0 else "worse" if low > 0.0 else "not distinguishable"


def better_in_all(book: Book, reference: str, name: str) -> str:
    """Whether a row is better than another in e_torso, e_ee and J_upper at once; if not, in which it is not."""
    found = {measure: compared(book, reference, name, measure) for measure in ALL_THREE}
    if reasons := [d["reason"] for d in found.values() if d["difference"] is None]:
        return f"({reasons[0]})"
    outcomes = {LABELS[measure].partition(" ")[0]: outcome(d) for measure, d in found.items()}
    others = [f"{name} {what}" for name, what in outcomes.items() if what != "better"]
    return f"no: {', '.join(others)}" if others else "**yes**"
