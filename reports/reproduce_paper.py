"""The paper's tables and figures, measured here, for H1 or G1: one page of Markdown, results.json and figures.

`--quick` takes fewer envs and writes to runs/paper-quick, `--only` takes parts and writes to runs/paper; without them,
docs/results.md (H1) or docs/results_ROBOT.md is written, with docs/results/ROBOT/.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from cotap.robots import ROBOTS
from reports.paper.ablation import ablation, samples
from reports.paper.book import POLICIES, Book
from reports.paper.constant_load import constant_load
from reports.paper.facet import facet
from reports.paper.fidelity import fidelity
from reports.paper.field import field
from reports.paper.impact import impact
from reports.paper.observation import observation
from reports.paper.periodic import periodic
from reports.paper.pictures import pictures
from reports.paper.sim_to_sim import sim_to_sim
from reports.paper.tables import PAPER_ROBOT
from reports.paper.walking import walking

PARTS: dict[str, Callable[[Book], None]] = {
    "impact": impact,
    "load": constant_load,
    "ablation": ablation,
    "periodic": periodic,
    "facet": facet,
    "observation": observation,
    "fidelity": fidelity,
    "walking": walking,
    "sim-to-sim": sim_to_sim,
    "field": field,
    "pictures": pictures,
}
HEAD = """Written by `{command}`: do not edit. {envs} envs a row unless said otherwise. Means are over the envs that
stood unless said otherwise; after ± stands the larger half of the 95 % interval, the bootstrap's or, of what happens or
does not, Wilson's. Shares of falls [%] are over all envs, from the start to the end of the episode, with Wilson's
interval in brackets. Arms that move play clips half of the time and generated motion otherwise. One training stands
behind each policy unless said otherwise: intervals are over envs, not over trainings. A difference between two rows is
taken env by env, over those that stood in both; both begin with the same friction, masses, motion and direction of the
push."""
IMPACT = """The impact is 500 N for 50 ms at the left hand, along x in stance, in a random horizontal direction while
walking at 0.5 m/s, arms moving; measured for 1 s from its onset. Friction, masses, gains and delay are
randomised, the torque limits are {robot}'s own. *K 100* is CoTaP at 100 N/m in x and y and 300 N/m in z, k_null 25
Nm/rad, and alpha 1 unless it is named; where a stiffness stands by itself (*K_ee 300*), it is that of all axes, and
k_null is that of the training. PD is plain PD with the CoTaP policy, which was trained under CoTaP alone, unless the
base policy is named; the paper's PD is that of FALCON's policy. The paper measured H1 in Isaac Gym,
with 4096 envs, and gives neither window nor torque limits: orderings and ratios compare, digits do not."""
ELSEWHERE = "Its Table I is in [laws](laws/properties.md)."


def main(argv: Sequence[str] | None = None) -> int:
    """Parse, measure, write the page. Returns the exit status; bad input ends the program with 2."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", default=PAPER_ROBOT, choices=tuple(ROBOTS), help="whose policies are measured")
    parser.add_argument("--quick", action="store_true", help="128 envs a row")
    parser.add_argument("--num-envs", type=int, default=0, help="envs a row; 4096, or 128 with --quick")
    parser.add_argument("--threads", type=int, default=0, help="0 takes every CPU")
    parser.add_argument("--only", nargs="+", default=[], metavar="PART", help=f"parts: {', '.join(PARTS)}")
    parser.add_argument("--reuse", action="store_true", help="keep evaluations that are there already")
    parser.add_argument(
        "--policies", nargs="+", default=[], action="extend", metavar="NAME=CHECKPOINT",
        help=f"names: {', '.join(POLICIES)}; by default cotap and base are those that ship",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, help="folder of the page, in place of those above")
    options = parser.parse_args(argv)
    try:
        book = open_book(options)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    begin(book, sys.argv[1:] if argv is None else argv)
    for name, part in PARTS.items():
        if not options.only or name in options.only:
            part(book)
            book.write()  # what is there, should a later part fail
    print(f"\nwritten: {book.page}")
    return 0


def open_book(options: argparse.Namespace) -> Book:
    """The empty page that the options ask for. Raises ValueError naming an option that cannot be met."""
    from cotap.checks import require_one_of, require_range

    for name in options.only:
        require_one_of("--only", name, PARTS.keys())
    require_range("--num-envs", options.num_envs, 0, 10**6)
    require_range("--threads", options.threads, 0, 4096)
    kept = Path("runs/paper-quick" if options.quick else "runs/paper")
    # A part alone is no page to put in the place of the whole one.
    folder = options.out or (kept if options.quick or options.only else Path("docs"))
    envs = options.num_envs or (128 if options.quick else 4096)
    policies = {name: f"{options.robot}-{name}" for name in ("cotap", "base")}
    policies |= given_policies(options.policies)
    evaluations = kept / "evaluations" / options.robot
    book = Book(options.robot, folder, evaluations, envs, options.threads, options.reuse, options.quick, policies)
    for name in filter(book.has, book.policies):
        robot = book.checkpoint(name)["layout"]["robot"]
        if robot != options.robot:
            raise ValueError(f"policy {name}: {book.policies[name]!r} is of {robot}, not of {options.robot} (--robot)")
    return book


def given_policies(texts: Sequence[str]) -> dict[str, str]:
    """Checkpoints by name of what `--policies` says. Raises ValueError for one that is unknown or not there."""
    from cotap.checks import require_one_of
    from cotap.evaluation.policy import shipped_names

    found = {}
    for text in texts:
        name, equals, path = text.partition("=")
        if not equals:
            raise ValueError(f"--policies must be NAME=CHECKPOINT, got {text!r}")
        require_one_of("--policies", name, POLICIES)
        if path not in shipped_names() and not Path(path).is_file():
            raise ValueError(f"--policies {name}: there is no file {path!r}; shipped are: {', '.join(shipped_names())}")
        found[name] = path
    return found


def begin(book: Book, arguments: Sequence[str]) -> None:
    """The head of the page, with the command that made it."""
    title = "The paper's tables and figures, measured here"
    book.add(f"# {title}" if book.robot == PAPER_ROBOT else f"# {title}, on {book.robot.upper()}")
    book.paragraph(HEAD, command=shlex.join(["python", "-m", "reports.reproduce_paper", *arguments]), envs=book.envs)
    book.paragraph(IMPACT, robot=book.robot.upper())
    there = filter(book.has, book.policies)
    measured = [f"`{name}` ({samples(book, name)} M samples{origin(book, name)})" for name in there]
    book.paragraph("Policies: {measured}.", measured=", ".join(measured) or "none of which there is a checkpoint")
    book.paragraph(ELSEWHERE)


def origin(book: Book, name: str) -> str:
    """What the page has to say of where a policy began: a comparison with the base is with its own, unless the
    page says otherwise."""
    from cotap.agents.checkpoint import sha256
    from cotap.evaluation.policy import find_checkpoint

    began = book.checkpoint(name)["config"].get("base")
    if not began or not book.has("base") or began["sha256"] == sha256(find_checkpoint(book.policies["base"])):
        return ""
    return ", begun from another base"


if __name__ == "__main__":
    sys.exit(main())
