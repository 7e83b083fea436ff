"""What the paper does not test: how hard a push robots survive, the punch tour, stiffness that changes."""

from __future__ import annotations

from typing import Any

from reports.paper.book import Book, slug
from reports.paper.figures import plot_fall_curves
from reports.paper.words import fallen, hundredfold, missing, number

LAWS = {"PD": ["--method", "pd"], "CoTaP, K 300": ["--method", "cotap", "--stiffness", "300"]}
TOUR_ENVS = 512
"""A tour takes twenty times as long as any other test here."""
SHORT_TOUR = ["--waypoints", "4", "--episode-seconds", "20"]
WHAT = """PD is that of the CoTaP policy. The pushes of the fall curve last {push:g} s, in random horizontal
directions, arms moving; {level} envs at each of {levels} impulses. The [tour](tour.md) moves
the arms itself, without the policy's own arm actions; its robots are nominal, and its PD has the gains of the tour (kp
{kp} Nm/rad). Where stiffness changes, arms are held. The tour and the peak torque are measured over all robots, each
until it fell."""
CHANGES = {"walking": ["--mode", "walking"], "standing under 15 N": ["--force", "0", "0", "-15"]}


def beyond(book: Book) -> None:
    """The table of all tests, and the fall curves."""
    from cotap.evaluation.fall_curve import FallCurve

    book.add("", "## Beyond the paper")
    envs, levels = max(book.envs, FallCurve.levels), FallCurve.levels
    book.paragraph(WHAT, push=FallCurve.duration, level=envs // levels, levels=levels, kp=tour_gains(book.robot))
    book.table("test", *LAWS)
    curves = run_all(book, "fall-curve", ["fall-curve"], envs)
    show(
        book,
        "impulse at the left hand at which half fall, standing [N s]",
        curves,
        lambda r: number(r["impulse_50"], 1),
    )
    tours = run_all(book, "tour", ["tour", *(SHORT_TOUR if book.quick else [])], min(TOUR_ENVS, book.envs))
    length = "the punch tour, 4 of 18 waypoints" if book.quick else "the punch tour"
    show(book, f"{length}: runs completed [%]", tours, lambda r: hundredfold(r["metrics"]["completed_fraction"]))
    show(
        book,
        "the same: mean time until the fall or the end [s]",
        tours,
        lambda r: number(r["metrics"]["survival_s"], 1),
    )
    changing(book)
    found = {name: result for name, result in curves.items() if result is not None}
    if found:
        caption = "Share of envs that fall within 3 s of a push on the left hand, against its impulse."
        plot_fall_curves(book.figure("fall_curve", caption), found)


def tour_gains(robot: str) -> str:
    """Position gains of the arms under PD on the tour [Nm/rad], the least and the largest."""
    from cotap.evaluation.tour.stance import tour_stance
    from cotap.robots import ROBOTS

    gains = tour_stance(ROBOTS[robot]()).arm_kp
    return " to ".join(dict.fromkeys(f"{bound:.0f}" for bound in (float(gains.min()), float(gains.max()))))


def run_all(book: Book, name: str, arguments: list[str], envs: int) -> dict[str, Any]:
    """A test under both laws; None where there is no checkpoint."""
    return {arms: book.run(f"{name}-{slug(arms)}", "cotap", *arguments, *law, envs=envs) for arms, law in LAWS.items()}


def show(book: Book, title: str, results: dict[str, Any], text: Any) -> None:
    """A row of what `text` says of each result."""
    book.row(title, *(missing("cotap") if result is None else text(result) for result in results.values()))


def changing(book: Book) -> None:
    """Stiffness and blend that change all the time."""
    for what, options in CHANGES.items():
        title = f"stiffness 80 to 1200 N/m and alpha 0 to 1, stepped and ramped for 10 s, {what}: fell [%]; peak torque"
        result = book.run(f"modulation-{slug(what)}", "cotap", "modulation", *options)
        found = missing("cotap")
        if result is not None:
            found = f"{fallen(result)}; {number(result['metrics']['peak_torque'], 1)} Nm"
        book.row(title, "-", found)
