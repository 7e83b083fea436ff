"""What a training without a part of CoTaP does: the paper's Table IV, beside CoTaP from three seeds."""

from __future__ import annotations

from typing import Any

from reports.paper.arms import CALM, cotap
from reports.paper.book import Book, row, slug
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
COLUMNS = (("e_torso", True), ("e_upper", True), ("e_upper", False))
"""Measures of the table, and whether the hand is pushed."""
BOLD = """In bold, of ablations with as many samples as the seeds, and of no training: outside the interval in which a
further training of CoTaP with another seed would lie with 95 % probability (Student's t)."""
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
        lengths = {samples(book, seed) for seed in seeds}
        as_long = policy == "base" or (book.has(policy) and lengths == {samples(book, policy)})
        table_row(book, name, policy, both, over if as_long else [])
    seeds_row(book, seeds, trained, over)
    table_row(book, "CoTaP", "cotap", measure_both(book, "cotap", "cotap", LAW), [])
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
    name, paper = "CoTaP, three seeds", printed(ABLATION["CoTaP"])
    if not seeds:
        return book.row(name, missing(SEEDS[0]), last=paper)
    if len(seeds) < len(SEEDS):
        name += f" ({len(seeds)} there)"
    shares = Trainings(tuple(100.0 * pushed["num_falls"] / pushed["num_envs"] for pushed, _ in trained))
    counts = ", ".join(dict.fromkeys(samples(book, seed) for seed in seeds))
    return book.add(row(name, counts, *(figure.text() for figure in over), shares.text(1), paper))


def twin(book: Book) -> str:
    """The policy under CoTaP that ablations are set against: the first seed, trained as long, or else what ships."""
    return SEEDS[0] if book.has(SEEDS[0]) else "cotap"


def samples(book: Book, policy: str) -> str:
    """What a policy was trained on, in millions."""
    return f"{book.checkpoint(policy)['samples'] / 1e6:.1f}"
