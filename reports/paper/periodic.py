"""Hands under a load that swings slowly: the paper's Fig. 7."""

from __future__ import annotations

from reports.paper.arms import NULL_STIFFNESS
from reports.paper.book import Book
from reports.paper.relative import keep_changes_of_sides
from reports.paper.words import fallen, missing, number, of, the_paper

LEFT = f"cotap:alpha=0.7,stiffness=500,null_stiffness={NULL_STIFFNESS}"
MODE, ARMS = "periodic load", "alpha 0.7, K 500"
CHANGING = {
    "elbow_amplitude": "elbow torque, amplitude", "elbow_rms": "elbow torque, rms", "energy": "work of the arm",
}  # fmt: skip
"""Measures of which the change from the arm under PD to the other is kept."""
ROWS = (
    ("elbow torque, amplitude [Nm]", "elbow_amplitude", 2, "left much smaller"),
    ("the same from statics [Nm]", "elbow_amplitude_static", 2, "-"),
    ("elbow torque, rms [Nm]", "elbow_rms", 2, "-"),
    ("the same from statics [Nm]", "elbow_rms_static", 2, "-"),
    ("swing of the hand in z, amplitude [m]", "hand_swing", 3, "left larger"),
)
"""Title, measure, digits, and what the paper shows."""
WHY = """{paper} has a left elbow that makes much less torque than the right one. Ours makes {ratio} of it; statics
asks for {static}, gravity less J^T F in the poses that were measured, which does not depend on stiffness."""


def periodic(book: Book) -> None:
    """Elbow torques under a slow load, beside statics."""
    from cotap.evaluation.periodic import PeriodicLoad

    book.add("", "## Periodic load (the paper's Fig. 7)")
    book.paragraph(
        "30 N in z with a period of 4 s on both hands, arms held; left arm alpha 0.7 with K_ee 500, right arm PD."
    )
    book.table("", "left", "right", "left over right", book.paper)
    result = book.run("periodic", "cotap", "periodic-load", "--left", LEFT, "--right", "pd")
    keep_changes_of_sides(book, MODE, "periodic", ARMS, CHANGING)
    for title, measure, digits, paper in ROWS:
        if result is None:
            book.row(title, missing("cotap"), last=paper)
            continue
        m = result["metrics_without_falls"]
        sides = (number(m[f"{measure}_{side}"], digits) for side in ("left", "right"))
        ratio = m.get(f"{measure}_ratio")
        book.row(title, *sides, number(ratio) if ratio else "-", last=paper)
    if result is not None:
        book.add("", f"Of the robots {fallen(result)} % fell.")
    book.paragraph(
        WHY,
        paper=the_paper(book),
        ratio=of(book, "periodic", "elbow_amplitude_ratio"),
        static=of(book, "periodic", "elbow_amplitude_static_ratio"),
    )
    if result is not None:
        PeriodicLoad().plot(book.figure("periodic_load", "Periodic load; dotted: statics."), result)
