"""Measures that others use for compliant humanoids, and what of them compares."""

from __future__ import annotations

from typing import Any

from cotap.robots import ROBOTS
from reports.paper.arms import CALM, PD, label
from reports.paper.book import Book
from reports.paper.words import hundredfold, missing, share

LAWS = {PD: ["--method", "pd"]} | {
    f"CoTaP, {k} N/m": ["--method", "cotap", "--stiffness", str(k)] for k in (100, 300, 800)
}
LOAD_N = 15.0
LONGER = ["--window", "0", "3"]
WHAT = """Free: standing while the arms move and nothing pushes, for 3 s. Loaded: {load:g} N down on the left
hand, arms held in their default pose. The impedance error is the distance of the hand from where a spring of the
stiffness that it was asked for would let it go; PD is asked for none. A joint is near its limit above nine tenths of
it."""
ROWS = (
    (
        "tracking error in free motion [cm]", "4.65", "5.22", "2.18",
        "in kind: here of the hands; the page does not say of which points theirs is",
    ),
    (
        "impedance error [cm]", "2.58", "3.92", "6.79",
        "in kind: here one force acts, on one hand; theirs act all over the body, pelvis and legs too",
    ),
    (
        "joints near their torque limit [%]", "0.93", "2.12", "2.74",
        "in kind: here of arms, waist and legs; the page does not say how near is near",
    ),
    ("trials without a fall [%]", "98", "91", "59", "no: other forces, and trials whose length the page does not give"),
    ("share of the reaction that the legs take [%]", "31", "14", "16", "not measured here"),
)  # fmt: skip
"""A measure, its figures on CompliantWBC's project page (September 2026), and whether it compares."""
OTHERS = """These figures, means in simulation, are those of the [project page](https://compliantwbc.github.io/) of
[CompliantWBC](https://arxiv.org/abs/2609.33310): a humanoid of 70 kg ({robot} has {mass:.0f} kg) that yields with its
whole body to forces anywhere on it. Robot and places of the forces differ, and the page does not name the motion that
is tracked, so that at most the order of size compares. [GentleHumanoid](https://arxiv.org/abs/2511.04679) makes
shoulder, elbow and wrist of a G1 compliant while its whole body tracks a motion. Its own abstract is about peak forces
of contact, in hugs for one, under thresholds of force that a user sets. Nothing here compares with them: here a force
is given, and none comes from touching a person or an object."""


def field(book: Book) -> None:
    """The measures, and the table of what compares."""
    book.add("", "## Measures of others")
    book.paragraph(WHAT, load=LOAD_N)
    book.table(
        "arms", "e_ee, free [cm]", "impedance error, loaded [cm]", "joints near their torque limit [%]: free",
        "loaded", "trials without a fall [%]: free", "loaded",
    )  # fmt: skip
    for name, law in LAWS.items():
        free = book.run(f"free-{_key(name)}", "cotap", "impact", *law, *CALM, *LONGER)
        loaded = book.run(f"held-{_key(name)}", "cotap", "constant-load", *law, "--force", "0", "0", f"-{LOAD_N:g}")
        if free is None or loaded is None:
            book.row(label(book.robot, name), missing("cotap"))
            continue
        m, under = free["metrics_without_falls"], loaded["metrics_without_falls"]
        near = (hundredfold(x.get("joints_near_limit")) for x in (m, under))
        error = hundredfold(under.get("impedance_error"), 2)
        book.row(
            label(book.robot, name), hundredfold(m["e_ee"], 2), error, *near, *(upright(r) for r in (free, loaded))
        )
    book.table(
        "measure", "CompliantWBC", "GentleHumanoid, there", "TWIST2 (stiff), there", "comparable with the above?"
    )
    for cells in ROWS:
        book.row(*cells)
    book.paragraph(OTHERS, robot=book.robot.upper(), mass=ROBOTS[book.robot]().mass_kg)


def upright(result: dict[str, Any]) -> str:
    """Share of trials without a fall to the end [%], with Wilson's interval."""
    return share(result["num_envs"] - result["num_falls"], result["num_envs"])


def _key(name: str) -> str:
    return name.replace("CoTaP, ", "").replace(" N/m", "")
