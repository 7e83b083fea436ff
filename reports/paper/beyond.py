"""What the paper does not test: how hard a push robots survive, stiffness that changes."""

from __future__ import annotations

from reports.paper.book import Book, slug
from reports.paper.figures import plot_fall_curves
from reports.paper.words import fallen, missing, number

LAWS = {"PD": ["--method", "pd"], "CoTaP, K 300": ["--method", "cotap", "--stiffness", "300"]}
WHAT = """PD is that of the CoTaP policy. The pushes of the fall curve last {push:g} s, in random horizontal
directions, arms moving; {level} envs at each of {levels} impulses. Where stiffness changes, arms are held; the peak
torque is measured over all robots, each until it fell."""
CHANGES = {"walking": ["--mode", "walking"], "standing under 15 N": ["--force", "0", "0", "-15"]}


def beyond(book: Book) -> None:
    """The table of all tests, and the fall curves."""
    from cotap.evaluation.fall_curve import FallCurve

    book.add("", "## Beyond the paper")
    envs, levels = max(book.envs, FallCurve.levels), FallCurve.levels
    book.paragraph(WHAT, push=FallCurve.duration, level=envs // levels, levels=levels)
    book.table("test", *LAWS)
    curves = {
        arms: book.run(f"fall-curve-{slug(arms)}", "cotap", "fall-curve", *law, envs=envs) for arms, law in LAWS.items()
    }
    half = (missing("cotap") if result is None else number(result["impulse_50"], 1) for result in curves.values())
    book.row("impulse at the left hand at which half fall, standing [N s]", *half)
    changing(book)
    found = {name: result for name, result in curves.items() if result is not None}
    if found:
        caption = "Share of envs that fall within 3 s of a push on the left hand, against its impulse."
        plot_fall_curves(book.figure("fall_curve", caption), found)


def changing(book: Book) -> None:
    """Stiffness and blend that change all the time."""
    for what, options in CHANGES.items():
        title = f"stiffness 80 to 1200 N/m and alpha 0 to 1, stepped and ramped for 10 s, {what}: fell [%]; peak torque"
        result = book.run(f"modulation-{slug(what)}", "cotap", "modulation", *options)
        found = missing("cotap")
        if result is not None:
            found = f"{fallen(result)}; {number(result['metrics']['peak_torque'], 1)} Nm"
        book.row(title, "-", found)
