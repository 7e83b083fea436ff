"""How close the stiffness that a hand shows is to the one that was asked for."""

from __future__ import annotations

from typing import Any

from reports.paper.book import Book
from reports.paper.words import NOT_MEASURED, fallen, missing, number

ENVS, TRACKED = 384, 1024
ALONE = ["--upper-actions", "reference"]
ROWS = (("joint", []), ("task", []), ("joint", ALONE), ("task", ALONE))
"""What stiffness acts on, and options."""
WHAT = """The paper has no such table. {envs} envs, robots nominal. A robot stands; its left hand is loaded along x, y
or z so that it should move by 2 cm, at 100 to 800 N/m, in poses with a condition number up to 8. The error is that of
the felt stiffness, as a share of the one asked for. In a mean over poses, errors of both signs hide each other; single
hands show them. Hands whose load takes more than nine tenths of an arm's torque are left out of the errors. Without the
policy's arm actions the hand feels the law alone."""


TRACKING = ["--method", "cotap", "--stiffness", "300", "--alpha", "1"]
UPPER = """Moving references at K 300, random commands for 20 s, {envs} envs, measured until a robot fell: e_upper is
{own} rad with the policy's arm actions, and {raw} rad with the raw reference as the arms' target."""


def fidelity(book: Book) -> None:
    """Errors of the mean over poses and of single hands, with both errors that stiffness may act on."""
    book.add("", "## Fidelity of the stiffness")
    envs = min(ENVS, book.envs)
    book.paragraph(WHAT, envs=envs)
    book.table(
        "arm actions", "stiffness acts on", "mean over poses, worst of x / y / z", "single hands: median, 95 % within",
        "went the wrong way", "left out", "fell [%]",
    )  # fmt: skip
    for error, options in ROWS:
        actions = "without" if options else "with"
        name = f"fidelity-{actions}-{error}"
        result = book.run(name, "cotap", "fidelity", "--error", error, *options, envs=envs)
        if result is None:
            book.row(actions, f"{error} error", missing("cotap"))
            continue
        book.row(
            actions, f"{error} error", " / ".join(worst(result["fidelity"], axis) for axis in "xyz"),
            single_hands(result["error_quantiles"]), str(result["num_wrong_way"]), str(result["num_unholdable"]),
            fallen(result),
        )  # fmt: skip
    upper_agent(book)


def upper_agent(book: Book) -> None:
    """What the arms' agent adds to the tracking of a moving reference."""
    envs, found = min(TRACKED, book.envs), []
    for name, options in (("walking-300-1", []), ("walking-300-1-alone", ALONE)):
        result = book.run(name, "cotap", "velocity-tracking", *TRACKING, *options, envs=envs)
        found.append(NOT_MEASURED if result is None else number(result["metrics"]["e_upper"]))
    book.paragraph(UPPER, envs=envs, own=found[0], raw=found[1])


def worst(rows: list[dict[str, Any]], axis: str) -> str:
    """The largest error of the mean over poses along an axis, with its sign and interval."""
    measured = [r for r in rows if r["axis"] == axis and r["n"] > 0]
    if not measured:
        return NOT_MEASURED
    if None in [r["error"] for r in measured]:
        return "no bound"
    largest = max(measured, key=lambda r: abs(r["error"]))
    return f"{largest['error']:+.0%} [{largest['ci95'][0]:+.0%},{largest['ci95'][1]:+.0%}]"


def single_hands(quantiles: dict[str, float | None] | None) -> str:
    """Median and 95th percentile; among hands some of which went the wrong way they may have no bound."""
    if quantiles is None:
        return NOT_MEASURED
    return ", ".join("no bound" if (q := quantiles[name]) is None else f"{q:.1%}" for name in ("50", "95"))
