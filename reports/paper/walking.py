"""Whether the CoTaP policy walks as well as the base, at every stiffness and blend."""

from __future__ import annotations

from typing import Any

from reports.paper.book import Book
from reports.paper.words import missing, number

SETTINGS = ((300, 0.0), *((stiffness, alpha) for stiffness in (100, 300, 500, 800) for alpha in (0.3, 0.7, 1.0)))
"""Stiffness of the hand [N/m] and alpha."""
ENVS = 1024
MEASURES = {
    "e_lin_gait": "velocity error, averaged over a stride [m/s]",
    "e_yaw": "yaw-rate error [rad/s]",
    "e_yaw_gait": "the same, averaged over a stride [rad/s]",
    "e_height": "height error [m]",
    "foot_slip": "foot slip [m/s]",
    "fall_fraction": "share that fell",
}
WHAT = """Random commands for 20 s, arms moving, randomisation on, {envs} envs, each measured until it fell. In bold:
worse than the base by more than 10 % and beyond its 95 % interval. At alpha 0 the hand's stiffness does nothing."""
SUMMARY = "Of {total} figures {kept} are no worse than the base's in this sense."


def walking(book: Book) -> None:
    """The walk at every stiffness and blend, beside the base's."""
    envs = min(ENVS, book.envs)
    book.add("", "## Walking at every stiffness")
    book.paragraph(WHAT, envs=envs)
    book.table("policy", "K_ee [N/m]", "alpha", *MEASURES.values())
    base = book.run("walking-base", "base", "velocity-tracking", "--method", "pd", envs=envs)
    if base is None:
        book.row("base, PD", "", "", missing("base"))
    else:
        book.row("base, PD", "", "", *(number(base["metrics"][measure]) for measure in MEASURES))
    verdicts: list[bool] = []
    for stiffness, alpha in SETTINGS:
        law = ["--method", "cotap", "--stiffness", str(stiffness), "--alpha", f"{alpha:g}"]
        result = book.run(f"walking-{stiffness}-{alpha:g}", "cotap", "velocity-tracking", *law, envs=envs)
        if result is None:
            book.row("CoTaP", str(stiffness) if alpha else "any", f"{alpha:g}", missing("cotap"))
            continue
        cells = []
        for measure in MEASURES:
            mine = result["metrics"][measure]
            good = None if base is None else no_worse(mine, base["metrics"][measure])
            text = "-" if mine["mean"] is None else f"{mine['mean']:.3f}"
            cells.append(f"**{text}**" if good is False else text)
            verdicts += [] if good is None else [good]
        book.row("CoTaP", str(stiffness) if alpha else "any", f"{alpha:g}", *cells)
    if verdicts:
        book.paragraph(SUMMARY, total=len(verdicts), kept=sum(verdicts))


def no_worse(mine: dict[str, Any], base: dict[str, Any]) -> bool | None:
    """Within 10 % of the base's mean, or not beyond its 95 % interval; None unless both were measured."""
    if mine["mean"] is None or base["mean"] is None:
        return None
    return mine["mean"] <= max([1.1 * base["mean"], *(base["ci95"] or [])[1:]])
