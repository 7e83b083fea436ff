"""FACET and the other laws beside CoTaP: the paper's Table VI and Fig. 9, by `reports.compare_laws`."""

from __future__ import annotations

from typing import Any

from reports.paper.ablation import samples, twin
from reports.paper.arms import NULL_STIFFNESS
from reports.paper.book import Book, kept
from reports.paper.words import missing, the_paper

STATIC_ENVS, STRUCK_ENVS = 384, 256
WHAT = """All laws at 500 N/m and k_null {null} Nm/rad, in stance, arms held, with the policy's own arm actions. {rows}
First 10, 30 and 50 N down on the left hand, robots nominal; displacements are relative to before the load. Then pushes
on it along x."""
OWN = """The row *facet* has the policy `facet`, trained on {facet} M samples, all others `{cotap}`, on {samples} M.
`facet` also begins with the base's arm agent, where CoTaP's begins anew."""
SHARED = "There is no policy `facet`: all rows have `cotap`."
WHY = """{paper} has a hand that rises under 10 and 30 N with CoTaP alone, and goes down under 50 N; ours goes down by
{cotap} cm. FACET moves the reference by F / K, and PD yields on top of it: {facet} cm. Under CoTaP + FACET
compliances add, so that twice F / K would be right: {both} cm."""


def facet(book: Book) -> None:
    """Displacements under loads, and what a hand does after a push, law by law."""
    book.add("", "## FACET and other laws (the paper's Table VI and Fig. 9)")
    own = book.has("facet")
    cotap = twin(book) if own else "cotap"
    if not book.has(cotap):
        book.paragraph(missing(cotap))
        return
    rows = OWN.format(facet=samples(book, "facet"), cotap=cotap, samples=samples(book, cotap)) if own else SHARED
    book.paragraph(WHAT, null=NULL_STIFFNESS, rows=rows)
    from reports.compare_laws import Static, Transient

    common: dict[str, Any] = {
        "checkpoint": book.policies[cotap], "facet_checkpoint": book.policies["facet"] if own else "",
        "null_stiffness": float(NULL_STIFFNESS), "upper_actions": "policy", "threads": book.threads,
    }  # fmt: skip
    at_rest = measured(
        book, "static", Static(num_envs=max(6, min(STATIC_ENVS, book.envs)), **common),
        "Displacement of the left hand under loads, downward; dashed: F / K.",
    )  # fmt: skip
    book.paragraph(
        WHY,
        paper=the_paper(book),
        cotap=moved(at_rest, "cotap, joint error"),
        facet=moved(at_rest, "facet"),
        both=moved(at_rest, "cotap+facet, joint error"),
    )
    measured(
        book, "transient", Transient(num_envs=min(STRUCK_ENVS, book.envs), **common),
        "Displacement of the left hand along x after a push; means and standard deviations over envs that stood.",
    )  # fmt: skip


def measured(book: Book, name: str, table: Any, caption: str) -> dict[str, Any]:
    """What a table of `compare_laws` measures, put on the page with its figure."""
    from cotap.agents.checkpoint import sha256
    from cotap.configs import to_plain
    from cotap.evaluation.policy import find_checkpoint
    from cotap.evaluation.report import save_figure

    policies = [path for path in (table.checkpoint, table.facet_checkpoint) if path]
    about = to_plain(table) | {"threads": 0, "policies": [sha256(find_checkpoint(path)) for path in policies]}
    result = kept(book.evaluations / f"laws-{name}.json", book.reuse, about, table.measure)
    book.add("", table.table(result).replace("| paper |", f"| {book.paper} |"))
    save_figure(table.draw(result), book.figure(f"laws_{name}", caption))
    return result


def moved(result: dict[str, Any], name: str) -> str:
    """How far down a row's hand goes under each load [cm]."""
    return " / ".join(
        "-" if value is None else f"{100.0 * value:.1f}" for value in result["rows"][name]["displacement"]
    )
