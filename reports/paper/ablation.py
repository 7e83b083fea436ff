"""What a training without a part of CoTaP does: the paper's Table IV, beside CoTaP from three seeds."""

from __future__ import annotations

from typing import Any

from reports.paper.arms import CALM, cotap
from reports.paper.book import Book, row, slug
from reports.paper.impact import MODES
from reports.paper.tables import ABLATION
from reports.paper.trainings import Trainings
from reports.paper.words import change, fallen, fell, missing, number, printed, the_paper

SEEDS = ("seed-0", "seed-1", "seed-2")
LAW = cotap(100, 100, 300)
WITHOUT_RATIO = ["--singularity-ratio", "False"]
ROWS = {
    "no training": ("base", [*LAW, "--upper-actions", "reference"]),
    "no training, with the base's own arm actions": ("base", LAW),
    "without the ratio": ("no-ratio", [*LAW, *WITHOUT_RATIO]),
    "arm torque for critics only": ("torque-critic", LAW),
    "goals observed": ("goals", LAW),
    "FACET": ("facet", ["--method", "facet", "--stiffness", "100", "100", "300"]),
}
"""Policy and options of each ablation."""
PUSHES = {
    f"{mode}, {impulse} N s on the {place}": [
        "--mode", mode, "--random-direction", "--place", place, "--force", force, "0", "0",
    ]
    for mode in MODES
    for place, force, impulse in (("hand", "500", 25), ("base", "1000", 50))
}  # fmt: skip
"""Pushes that tell who falls, and options of `impact`: those of the evaluations that ship."""
NO_TRAININGS = [Trainings(())] * len(PUSHES)
"""What a row is set against that is set against nothing."""
COLUMNS = (("e_torso", True), ("e_upper", True), ("e_upper", False))
"""Measures of the table, and whether the hand is pushed."""
BOLD = """In bold, of ablations with as many samples as the seeds, and of no training: outside the interval in which a
further training of CoTaP with another seed would lie with 95 % probability (Student's t)."""
FALLS = """Who falls, pushed for 50 ms in any horizontal direction, arms moving, standing and walking at 0.5 m/s: on
the left hand, and twice as hard on the base."""
BASE = """{paper} had a base that could not be controlled under compliance; of ours, {own} % fell with its own arm
actions. With the raw reference as target, the paper's arms followed it half as well as with CoTaP; of ours, {base} %
fell, of CoTaP's {cotap} %, and from CoTaP to no training e_upper changes by {push} rad with the push, by {calm} rad
without."""
LAW_ALONE = """With CoTaP's own policy and the ratio left out of the law alone, e_upper without a push changes by {law}
rad."""
TRAINED = """The paper's policy without the ratio shuns stretched arms (0.517 rad). Ours, trained so, changes e_upper
without a push by {trained} rad from that of `{twin}`."""


def ablation(book: Book) -> None:
    """The ablation table, in stance at K 100."""
    book.add("", "## Ablation (the paper's Table IV)")
    book.paragraph(
        "The impact in stance at K_ee 100. *No training*: the base's legs, the raw reference as the arms' target. "
        "Samples are those of the distillation, the base's of its own training; intervals of a row are over its envs."
    )
    seeds = [name for name in SEEDS if book.has(name)]
    trained = [measure_both(book, name, name, LAW) for name in seeds]
    over = [Trainings(tuple(v for p in trained if (v := mean_of(p, *column)) is not None)) for column in COLUMNS]
    book.table(
        "what", "samples [M]", "e_torso [m/s]", "e_upper [rad]", "e_upper without the push [rad]", "fell [%]",
        f"{book.paper}: e_torso / e_upper",
    )  # fmt: skip
    for name, (policy, options) in ROWS.items():
        both = measure_both(book, slug(name), policy, options)
        table_row(book, name, policy, both, over if as_long(book, policy, seeds) else [])
    seeds_row(book, seeds, trained, over)
    table_row(book, "CoTaP", "cotap", measure_both(book, "cotap", "cotap", LAW), [])
    falls(book, seeds)
    book.run("calm-law-alone", "cotap", "impact", *LAW, *WITHOUT_RATIO, *CALM)
    if len(seeds) > 1:
        book.paragraph(BOLD)
    book.paragraph(
        BASE,
        paper=the_paper(book),
        own=fell(book, "ablation-no-training-with-the-base-s-own-arm-actions"),
        base=fell(book, "ablation-no-training"),
        cotap=fell(book, "ablation-cotap"),
        push=change(book, "ablation-cotap", "ablation-no-training", "e_upper"),
        calm=change(book, "calm-cotap", "calm-no-training", "e_upper"),
    )
    book.paragraph(LAW_ALONE, law=change(book, "calm-cotap", "calm-law-alone", "e_upper"))
    if book.has("no-ratio"):
        trained = change(book, f"calm-{twin(book)}", "calm-without-the-ratio", "e_upper")
        book.paragraph(TRAINED, trained=trained, twin=twin(book))


def as_long(book: Book, policy: str, seeds: list[str]) -> bool:
    """Whether a policy is set against the seeds: the base, and ablations with as many samples."""
    lengths = {samples(book, seed) for seed in seeds}
    return policy == "base" or (book.has(policy) and lengths == {samples(book, policy)})


def falls(book: Book, seeds: list[str]) -> None:
    """The share of each ablation that falls, beside the seeds'."""
    book.paragraph(FALLS)
    book.table("what, share that fell [%]", *PUSHES)
    trained = [fall_results(book, seed, seed, LAW) for seed in seeds]
    over = [Trainings(tuple(share_fallen(found[i]) for found in trained)) for i in range(len(PUSHES))]
    for name, (policy, options) in ROWS.items():
        falls_row(book, name, policy, options, over if as_long(book, policy, seeds) else NO_TRAININGS)
    book.row(seeds_name(seeds), *([figure.text(1) for figure in over] if seeds else [missing(SEEDS[0])]))
    falls_row(book, "CoTaP", "cotap", LAW, NO_TRAININGS)


def fall_results(book: Book, name: str, policy: str, options: list[str]) -> list[Any]:
    """The results under each of `PUSHES`; None of each where there is no checkpoint."""
    return [book.run(f"falls-{name}-{slug(push)}", policy, "impact", *options, *how) for push, how in PUSHES.items()]


def falls_row(book: Book, name: str, policy: str, options: list[str], over: list[Trainings]) -> None:
    """A policy's row, in bold what lies outside the interval `over` trainings."""
    found = fall_results(book, slug(name), policy, options)
    if None in found:
        return book.row(name, missing(policy))
    shown = ((fallen(result), figure.outside(share_fallen(result))) for result, figure in zip(found, over, strict=True))
    return book.row(name, *(f"**{text}**" if bold else text for text, bold in shown))


def share_fallen(result: Any) -> float:
    """[%]."""
    return 100.0 * result["num_falls"] / result["num_envs"]


def measure_both(book: Book, name: str, policy: str, options: list[str]) -> tuple[Any, Any]:
    """The results with the push and without; None of each where there is no checkpoint."""
    pushed = book.run(f"ablation-{name}", policy, "impact", *options)
    return pushed, book.run(f"calm-{name}", policy, "impact", *options, *CALM)


def mean_of(both: tuple[Any, Any], measure: str, pushed: bool) -> float | None:
    """The mean of a measure over the envs that stood, None without one."""
    return both[0 if pushed else 1]["metrics_without_falls"][measure]["mean"]


def table_row(book: Book, name: str, policy: str, both: tuple[Any, Any], over: list[Trainings]) -> None:
    """A policy's row, in bold what lies outside the interval `over` trainings."""
    paper = printed(ABLATION.get(name))
    if both[0] is None:
        return book.row(name, missing(policy), last=paper)
    cells = []
    for i, (measure, pushed) in enumerate(COLUMNS):
        text, value = number(both[0 if pushed else 1]["metrics_without_falls"][measure]), mean_of(both, measure, pushed)
        cells.append(f"**{text}**" if over and value is not None and over[i].outside(value) else text)
    return book.row(name, samples(book, policy), *cells, fallen(both[0]), last=paper)


def seeds_row(book: Book, seeds: list[str], trained: list[tuple[Any, Any]], over: list[Trainings]) -> None:
    """The row of CoTaP's trainings with three seeds, or of as many as there are."""
    name, paper = seeds_name(seeds), printed(ABLATION["CoTaP"])
    if not seeds:
        return book.row(name, missing(SEEDS[0]), last=paper)
    shares = Trainings(tuple(share_fallen(struck) for struck, _ in trained))
    counts = ", ".join(dict.fromkeys(samples(book, seed) for seed in seeds))
    return book.add(row(name, counts, *(figure.text() for figure in over), shares.text(1), paper))


def seeds_name(seeds: list[str]) -> str:
    """What the row of the seeds that are there is called."""
    return "CoTaP, three seeds" + (f" ({len(seeds)} there)" if 0 < len(seeds) < len(SEEDS) else "")


def twin(book: Book) -> str:
    """The policy under CoTaP that ablations are set against: the first seed, trained as long, or else what ships."""
    return SEEDS[0] if book.has(SEEDS[0]) else "cotap"


def samples(book: Book, policy: str) -> str:
    """What a policy was trained on, in millions."""
    return f"{book.checkpoint(policy)['samples'] / 1e6:.1f}"
