"""A load on a hand: the paper's Fig. 4."""

from __future__ import annotations

from reports.paper.arms import PD, cotap
from reports.paper.book import Book, slug
from reports.paper.figures import plot_curves
from reports.paper.relative import keep_changes
from reports.paper.tables import LOAD
from reports.paper.words import fallen, missing, number, of, the_paper, verdict

MODE = "constant load"
ROWS = {
    "K_z 100": cotap(300, 300, 100),
    "K_z 500": cotap(300, 300, 500),
    "K_z 1000": cotap(300, 300, 1000),
    PD: ["--method", "pd"],
    "alpha 0.5": cotap(300, 300, 100, 0.5),
}
COMPLIANT = tuple(name for name in ROWS if name != PD)
CHANGING = ("e_torso", "e_ee_hit", "j_upper")
"""Measures of which the change from PD is kept."""
CLAIMS = (
    ("Hand error at K_z 500 below that at 100", "K_z 500", "K_z 100", "e_ee_hit"),
    ("Hand error at alpha 0.5 below that at K_z 100", "alpha 0.5", "K_z 100", "e_ee_hit"),
    (
        "At alpha 0.5 a smaller share of the way beyond the rest than under PD",
        "alpha 0.5",
        PD,
        "load_overshoot",
    ),
    ("At alpha 0.5 a smaller share than at K_z 100", "alpha 0.5", "K_z 100", "load_overshoot"),
)
"""Of the paper: what is smaller in the first row than in the second."""
WHY = """{paper} has a hand error in z of 0.05 m at K_z 500, where F / K is 0.10 m and ours goes {stiff} m in z, and of
0.12 m at K_z 100, where ours goes {soft} m. F / K is 0.5 m there, more than an arm can reach. What may shorten the
way: near an arm's end the ratio gives way to PD, stiffness acts on joint errors, which is exact for small displacements
only, joints have torque limits, and the policy's own arm actions act, too. Under PD the paper's hand reverses
(-0.03 m); ours rests {pd} m from where it was, negative on the load's side. On the way there ours goes beyond its rest
by {pd_over} of the way under PD and {blend_over} at alpha 0.5."""


def constant_load(book: Book) -> None:
    """Displacement and error of the hand under -50 N."""
    book.add("", "## Constant load (the paper's Fig. 4)")
    book.paragraph(
        "-50 N in z on the left hand from 1 s on, stance, arms held, x and y 300 N/m; 2 to 4 s after the onset. "
        "Displacements are relative to the half second before."
    )
    book.table(
        "arms",
        "displacement in z [m]",
        "hand error, all axes [m]",
        "first beyond its rest by, share of its way",
        "fell [%]",
        book.paper,
    )
    curves = {}
    for name, law in ROWS.items():
        result = book.run(key(name), "cotap", "constant-load", *law)
        paper = LOAD.get(name, "-")
        if result is None:
            book.row(name, missing("cotap"), last=paper)
            continue
        m, curve = result["metrics_without_falls"], result["curve"]
        over = number(m.get("load_overshoot"), 2)
        book.row(name, number(m["displacement_z"]), number(m["e_ee_hit"]), over, fallen(result), last=paper)
        curves[name] = (curve["time"], curve.get("hand_displacement_z", []))
    keep_changes(book, MODE, "load", COMPLIANT, CHANGING)
    book.paragraph(
        WHY,
        paper=the_paper(book),
        stiff=of(book, key("K_z 500"), "displacement_z"),
        soft=of(book, key("K_z 100"), "displacement_z"),
        pd=of(book, key(PD), "displacement_z"),
        pd_over=of(book, key(PD), "load_overshoot", 2),
        blend_over=of(book, key("alpha 0.5"), "load_overshoot", 2),
    )
    book.table(f"claim of the {book.paper}", "here")
    for claim, smaller, larger, measure in CLAIMS:
        book.row(claim, verdict(book, key(smaller), key(larger), measure))
    if curves:
        path = book.figure("constant_load", "Displacement of the left hand in z under -50 N; means of envs that stood.")
        plot_curves(path, curves, "time since the load set in [s]", "displacement in z [m]")


def key(name: str) -> str:
    """The name of a row's evaluation."""
    return f"load-{slug(name)}"
