"""How close the stiffness that a hand shows is to the one that was asked for."""

from __future__ import annotations

from typing import Any

from reports.paper.book import Book
from reports.paper.figures import plot_trade_off
from reports.paper.relative import relative_change
from reports.paper.words import NOT_MEASURED, fallen, missing, number

ENVS, TRACKED = 3072, 1024
ALONE = ["--upper-actions", "reference"]
ROWS = (("joint", []), ("task", []), ("joint", ALONE), ("task", ALONE))
"""What stiffness acts on, and options."""
ALLOWED = {"joint": 0.05, "task": 0.03}
"""Largest error of a mean over poses, by what stiffness acts on, as a share of the stiffness asked for."""
WHAT = """The paper has no such table. {envs} envs, robots nominal. A robot stands; its left hand is loaded along x, y
or z so that it should move by 2 cm, at 100 to 800 N/m, in {poses} poses with a condition number up to 8. The error is
that of the felt stiffness, as a share of the one asked for; intervals are over poses. In a mean over poses, errors of
both signs hide each other; single hands show them. Left out are hands whose arm touches the body, before the load or
under it, and hands whose load takes more than nine tenths of an arm's torque. Without the policy's arm actions the hand
feels the law alone."""

TRACKING = ["--method", "cotap", "--stiffness", "300", "--alpha", "1"]
SHARES: dict[str, list[str]] = {
    "0": ALONE, **{share: ["--upper-actions", share] for share in ("0.25", "0.5", "0.75")}, "1": [],
}  # fmt: skip
"""Shares of the policy's arm actions that are left, and options."""
UPPER = """What the arms' agent adds: moving references at K 300 and alpha 1, random commands for 20 s, {envs} envs,
measured until a robot fell, beside the felt stiffness, on which the joint error acts, with the same share of its
actions. Changes are env by env, from the raw reference as the arms' target, over robots that stood in both."""
BETTER = 0.2
VERDICT = "That the agent follows moving references at least {least:.0%} better than the raw reference: {found}."


def fidelity(book: Book) -> None:
    """Errors of the mean over poses and of single hands, with both errors that stiffness may act on."""
    from cotap.evaluation.fidelity import Fidelity

    book.add("", "## Fidelity of the stiffness")
    envs = min(ENVS, book.envs)
    cells = 3 * len(Fidelity.stiffness_values)
    book.paragraph(WHAT, envs=envs, poses=-(-envs // cells))
    book.table(
        "arm actions", "stiffness acts on", "mean over poses, worst of x / y / z", "all within",
        "single hands: median, 95 % within", "went the wrong way", "left out: touches the body / load too large",
        "fell [%]",
    )  # fmt: skip
    for error, options in ROWS:
        actions = "without" if options else "with"
        result = book.run(f"fidelity-{actions}-{error}", "cotap", "fidelity", "--error", error, *options, envs=envs)
        if result is None:
            book.row(actions, f"{error} error", missing("cotap"))
            continue
        book.row(
            actions, f"{error} error", " / ".join(worst(result["fidelity"], axis) for axis in "xyz"),
            f"{ALLOWED[error]:.0%}: {within(result['fidelity'], ALLOWED[error])}",
            single_hands(result["error_quantiles"], result["error_quantiles_ci95"]), str(result["num_wrong_way"]),
            f"{result['num_touching']} / {result['num_unholdable']}", fallen(result),
        )  # fmt: skip
    upper_agent(book, envs)


def upper_agent(book: Book, envs: int) -> None:
    """What the arms' agent adds to the tracking of a moving reference, and what it takes from the felt stiffness."""
    tracked = min(TRACKED, book.envs)
    book.paragraph(UPPER, envs=tracked)
    book.table(
        "share of the arm actions", "e_upper [rad]", "change from none", "mean over poses, worst of x / y / z",
        "single hands: median, 95 % within",
    )  # fmt: skip
    points: list[tuple[str, float, float]] = []
    changes: dict[str, dict[str, Any]] = {}
    for share, options in SHARES.items():
        name = "walking-300-1" if share == "1" else f"walking-300-1-arms-{share}"  # the first is the walk's, too
        track = book.run(name, "cotap", "velocity-tracking", *TRACKING, *options, envs=tracked)
        actions = {"0": "without", "1": "with"}.get(share, share)
        felt = book.run(f"fidelity-{actions}-joint", "cotap", "fidelity", "--error", "joint", *options, envs=envs)
        if track is None or felt is None:
            book.row(share, missing("cotap"))
            continue
        raw = book.results["walking-300-1-arms-0"]
        changes[share] = relative_change(raw["per_env"], track["per_env"], "e_upper")
        e_upper, single = track["metrics"]["e_upper"], felt["error_quantiles"]
        book.row(
            share, number(e_upper), "-" if share == "0" else relative(changes[share]),
            " / ".join(worst(felt["fidelity"], axis) for axis in "xyz"),
            single_hands(single, felt["error_quantiles_ci95"]),
        )  # fmt: skip
        if single and single["95"] is not None and e_upper["mean"] is not None:
            points.append((share, e_upper["mean"], 100.0 * single["95"]))
    if "1" in changes:
        book.paragraph(VERDICT, least=BETTER, found=verdict(changes["1"]))
    if points:
        caption = "Tracking of moving references against the felt stiffness, by the share of the policy's arm actions."
        plot_trade_off(book.figure("upper_agent", caption), points)


def relative(change: dict[str, Any]) -> str:
    """A relative change with its interval [%]."""
    if change["mean"] is None:
        return f"({change['reason']})"
    low, high = change["ci95"]
    return f"{change['mean']:+.1%} [{low:+.1%},{high:+.1%}]"


def verdict(change: dict[str, Any]) -> str:
    """Whether an error falls by `BETTER` or more, as the interval of its relative change has it."""
    if change["mean"] is None:
        return relative(change)
    low, high = change["ci95"]
    word = "holds" if high <= -BETTER else "does not hold" if low > -BETTER else "undecided"
    return f"**{word}**, {relative(change)}"


def worst(rows: list[dict[str, Any]], axis: str) -> str:
    """The largest error of the mean over poses along an axis, with its sign and interval."""
    measured = [r for r in rows if r["axis"] == axis and r["n"] > 0]
    if not measured:
        return NOT_MEASURED
    if None in [r["error"] for r in measured]:
        return "no bound"
    largest = max(measured, key=lambda r: abs(r["error"]))
    shown = "[{:+.1%},{:+.1%}]".format(*largest["ci95"]) if largest["ci95"] else f"({largest['reason']})"
    return f"{largest['error']:+.1%} {shown}"


def within(rows: list[dict[str, Any]], allowed: float) -> str:
    """Whether the means over poses of all axes and stiffnesses err by no more than `allowed`, by their intervals."""
    measured = [r for r in rows if r["n"] > 0]
    if not measured:
        return NOT_MEASURED
    intervals = [r["ci95"] for r in measured]
    if None in intervals or any(low > allowed or high < -allowed for low, high in intervals):
        return "no"
    return "**yes**" if all(-allowed <= low and high <= allowed for low, high in intervals) else "undecided"


def single_hands(quantiles: dict[str, float | None] | None, intervals: dict[str, list[float | None]] | None) -> str:
    """Median and 95th percentile, and where that lies; among hands some of which went the wrong way they may have no
    bound."""
    if quantiles is None or intervals is None:
        return NOT_MEASURED
    median, most, low, high = (
        "no bound" if q is None else f"{q:.1%}" for q in (quantiles["50"], quantiles["95"], *intervals["95"])
    )
    return f"{median}, {most} [{low},{high}]"
