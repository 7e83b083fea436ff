"""A push on a hand: the paper's Table III, its orderings, and the same without torque limits and by mass."""

from __future__ import annotations

from cotap.robots import ROBOTS
from reports.paper.arms import CALM, COMPLIANT, PD, SOFT, arms, label
from reports.paper.book import Book, slug
from reports.paper.relative import keep_changes
from reports.paper.tables import IMPACT, ORDERINGS, PAPER_ROBOT
from reports.paper.words import (
    ALL_THREE,
    DIGITS,
    LABELS,
    better_in_all,
    change,
    fallen,
    fell,
    missing,
    number,
    of,
    printed,
    the_paper,
    verdict,
)

MODES = {"stance": ["--mode", "stance"], "walking": ["--mode", "walking", "--random-direction"]}
FORCE_N, DURATION_S = 500.0, 0.05
SCALED = 10.0
"""Factor on the torque limits at which an impact saturates nothing."""

STANCE = """{paper} gives neither its window nor its torque limits. It has J_upper under PD at 49.7 Nm; ours is
{second} Nm over 1 s, {early} Nm over the first 0.1 s, and at K 100 without any push {calm} Nm. From PD to K 100 its
e_torso rises from 0.701 to 0.861 m/s; ours changes by {torso} m/s. Arms under CoTaP are critically damped here; under
PD they have the robot's own damping. The paper gives no share of falls; of ours at K 100, {fell} % fell."""

WALKING = """{paper} has errors of the torso of 2.1 m/s. A push of {impulse:g} N s changes the velocity of H1's
{mass:.0f} kg by {velocity:.2f} m/s, so that errors of this size are not the push's alone, over any window. Robots that
fall, or do not walk as commanded, would explain them. At K 100 ours have an error of {torso} m/s, robots that fell
left out; {fell} % fell."""

ANY_FORCE_N = (500.0, 1000.0)
ANY_DIRECTION = """The push of 50 ms at the left hand has a random horizontal direction; the arms move."""

COMPARED = """By the 95 % intervals of the differences, env by env, from PD with the same policy and with the base.
Less is better. Where the answer is no, the measures that are not named are better."""

LIMITS = """Under the robot's own torque limits, an arm joint is at its limit for {own} of the time at K 100, here for
{free}. e_ee: K 500 < K 100: with the limits {with_limits}; without them {without_limits}."""

BY_MASS = """The push of {impulse:g} N s is the paper's, made smaller by the ratio of the robot's mass to H1's."""


def impact(book: Book) -> None:
    """All impact tables."""
    book.add("", "## Impact (the paper's Table III)")
    for mode in MODES:
        measure_mode(book, mode)
    any_direction(book)
    compare_with_pd(book)
    orderings(book)
    without_limits(book)
    if book.robot != PAPER_ROBOT:
        by_mass(book)


def key(mode: str, arms_name: str, variant: str = "") -> str:
    """The name of a row's evaluation."""
    return "-".join(filter(None, ("impact", mode, variant, slug(arms_name))))


def measure_mode(book: Book, mode: str) -> None:
    """The table of one mode and what is to say about it."""
    rows = arms(book.robot)
    book.add("", f"### {mode.capitalize()}")
    book.table("arms", *LABELS.values(), "fell [%]", f"{book.paper}: e_torso / e_ee / J_upper")
    for name, law in rows.items():
        measure_row(
            book, label(book.robot, name), "cotap", key(mode, name), [*MODES[mode], *law], IMPACT[mode].get(name)
        )
    for name in (PD, SOFT):
        base = f"{label(book.robot, name)}, base policy"
        measure_row(book, base, "base", key(mode, name, "base"), [*MODES[mode], *rows[name]], IMPACT[mode][name])
    keep_changes(book, mode, f"impact-{mode}")
    (stance if mode == "stance" else walking)(book)


def measure_row(
    book: Book, name: str, policy: str, key: str, options: list[str], paper: tuple[float, ...] | None
) -> None:
    """A row of the table of one mode."""
    result = book.run(key, policy, "impact", *options)
    if result is None:
        return book.row(name, missing(policy), last=printed(paper))
    m = result["metrics_without_falls"]
    cells = [number(m[measure], DIGITS.get(measure, 3)) for measure in LABELS]
    return book.row(name, *cells, fallen(result), last=printed(paper))


def any_direction(book: Book) -> None:
    """Who falls, whatever the direction of the push, also of one twice as strong."""
    book.add("", "### Falls, pushed in any direction")
    book.paragraph(ANY_DIRECTION)
    pushes = [(f"{mode}, {force * DURATION_S:g} N s", mode, force) for mode in MODES for force in ANY_FORCE_N]
    book.table("arms, share that fell [%]", *(title for title, *_ in pushes))
    for name, law in arms(book.robot).items():
        found = []
        for _, mode, force in pushes:
            options = ["--mode", mode, "--random-direction", "--force", f"{force:g}", "0", "0", *law]
            same = mode == "walking" and force == FORCE_N  # as in the table above
            known = book.results.get(key(mode, name)) if same else None
            result = known or book.run(key(mode, name, f"any-{force:g}"), "cotap", "impact", *options)
            found.append(missing("cotap") if result is None else fallen(result))
        book.row(label(book.robot, name), *found)


def stance(book: Book) -> None:
    """Where ours differs in stance."""
    pd, k100 = key("stance", PD), key("stance", "K 100")
    book.run("calm-cotap", "cotap", "impact", *arms(book.robot)["K 100"], *CALM)
    book.paragraph(
        STANCE,
        paper=the_paper(book),
        second=of(book, pd, "j_upper", 1),
        early=of(book, pd, "j_upper_push", 1),
        calm=of(book, "calm-cotap", "j_upper", 1),
        torso=change(book, pd, k100, "e_torso"),
        fell=fell(book, k100),
    )


def walking(book: Book) -> None:
    """Where ours differs in walking."""
    k100, impulse, weight = key("walking", "K 100"), FORCE_N * DURATION_S, ROBOTS[PAPER_ROBOT]().mass_kg
    book.paragraph(
        WALKING,
        paper=the_paper(book),
        impulse=impulse,
        mass=weight,
        velocity=impulse / weight,
        torso=of(book, k100, "e_torso"),
        fell=fell(book, k100),
    )


def compare_with_pd(book: Book) -> None:
    """Whether each row is better than PD in all three measures of the paper."""
    book.add("", "### Better than PD in e_torso, e_ee and J_upper at once?")
    book.paragraph(COMPARED)
    references = {"PD": "", "PD, base policy": "base"}
    columns = [(mode, variant, f"{mode}, than {name}") for mode in MODES for name, variant in references.items()]
    book.table("arms", *(title for *_, title in columns))
    for name in arms(book.robot):
        if name != PD:
            found = (better_in_all(book, key(mode, PD, variant), key(mode, name)) for mode, variant, _ in columns)
            book.row(label(book.robot, name), *found)


def orderings(book: Book) -> None:
    """Every ordering of the paper's table with its verdict."""
    book.add("", "### The paper's orderings")
    book.table(f"ordering of the {book.paper}", *MODES, *(f"{mode}, first 0.1 s" for mode in MODES))
    for measure, smaller, larger in ORDERINGS:
        windows = ("j_upper", "j_upper_push") if measure == "j_upper" else (measure,)
        found = (
            verdict(book, key(mode, smaller), key(mode, larger), shown, DIGITS.get(shown, 3))
            for shown in windows
            for mode in MODES
        )
        book.row(f"{LABELS[measure].partition(' ')[0]}: {smaller} < {larger}", *found)


def without_limits(book: Book) -> None:
    """The impact in stance with ten times the torque limits."""
    book.add("", f"### Stance, {SCALED:g} times the torque limits")
    few_columns(book, "x10", {"stance": MODES["stance"]}, (PD, "K 100", "K 500"),
                ["--torque-limit-scale", f"{SCALED:g}"])  # fmt: skip
    book.paragraph(
        LIMITS,
        own=of(book, key("stance", "K 100"), "share_at_limit", 2),
        free=of(book, key("stance", "K 100", "x10"), "share_at_limit", 2),
        with_limits=verdict(book, key("stance", "K 500"), key("stance", "K 100"), "e_ee"),
        without_limits=verdict(book, key("stance", "K 500", "x10"), key("stance", "K 100", "x10"), "e_ee"),
    )


def by_mass(book: Book) -> None:
    """The impact of an impulse that is to this robot's mass as the paper's is to H1's."""
    force = FORCE_N * ROBOTS[book.robot]().mass_kg / ROBOTS[PAPER_ROBOT]().mass_kg
    book.add("", "### Impulse by mass")
    few_columns(book, "by-mass", MODES, (PD, *COMPLIANT), ["--force", f"{force:.1f}", "0", "0"])
    book.paragraph(BY_MASS, impulse=round(force * DURATION_S, 1))
    for mode in MODES:
        keep_changes(book, f"{mode}, impulse by mass", f"impact-{mode}-by-mass")


def few_columns(
    book: Book, variant: str, modes: dict[str, list[str]], names: tuple[str, ...], options: list[str]
) -> None:
    """A table of e_torso, e_ee and J_upper of some rows."""
    book.table("mode", "arms", *(LABELS[measure] for measure in ALL_THREE), "fell [%]")
    for mode, where in modes.items():
        for name in names:
            law = arms(book.robot)[name]
            result = book.run(key(mode, name, variant), "cotap", "impact", *where, *law, *options)
            if result is None:
                book.row(mode, label(book.robot, name), missing("cotap"))
                continue
            m = result["metrics_without_falls"]
            cells = (number(m[measure], DIGITS.get(measure, 3)) for measure in ALL_THREE)
            book.row(mode, label(book.robot, name), *cells, fallen(result))
