"""Changes the code a little, one place at a time, and counts how often the tests notice: `make mutants`.

A mutant that no test notices has survived: a behaviour that nothing asserts. All mutants of all rooms take many hours.
So a seeded sample of each room runs: places by chance, and at each one of its changes by chance. `--all` runs
everything. `--again` runs those once more that survived last time, in the file of results. Exit status 1 if fewer than
95 % of the mutants of a room are killed.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmarks.mutant_rooms import ROOMS
from benchmarks.mutant_rules import Mutant, mutants_of
from benchmarks.mutant_runs import Runner, copied_tree

ROOT = Path(__file__).resolve().parent.parent
EQUIVALENT = Path(__file__).with_name("equivalent_mutants.json")
LEAST_KILLED = 0.95
KILLED, SURVIVED, EQUAL = VERDICTS = ("killed", "survived", "equivalent")


@dataclass(frozen=True)
class Tried:
    """What became of a mutant."""

    mutant: Mutant
    before: str
    """The line that it changes."""
    after: str
    verdict: str


Results = dict[str, list[Tried]]
"""By room."""
Reasons = dict[tuple[str, str, str], str]
"""Why a mutant changes nothing: by file, line and mutated line, both without spaces."""


def main() -> int:
    args = _arguments()
    reasons = known_equivalents()
    results = _read(args.results) if args.results.exists() else {}
    with copied_tree(ROOT) as tree:
        runner = Runner(tree)
        for room in args.rooms:
            rows = {t.mutant: t for t in results.get(room, [])} if args.again else {}
            mutants = _survivors(tree, list(rows.values())) if args.again else _chosen(tree, room, args)
            for number, mutant in enumerate(mutants, 1):
                rows[mutant] = _try(runner, tree, room, mutant, reasons)
                results[room] = list(rows.values())
                _write(args.results, results)  # each time, so that an interrupted run is not lost
                _progress(room, number, len(mutants), rows[mutant])
    return report({room: results.get(room, []) for room in args.rooms})


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", nargs="+", choices=ROOMS, default=list(ROOMS), metavar="ROOM", help=", ".join(ROOMS))
    parser.add_argument("--sample", type=int, default=100, metavar="N", help="places per room (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the sample (default: %(default)s)")
    parser.add_argument("--all", action="store_true", help="every mutant of every place")
    parser.add_argument("--again", action="store_true", help="only those that survived last time")
    parser.add_argument("--results", type=Path, default=ROOT / "runs/mutants.json", help="(default: %(default)s)")
    args = parser.parse_args()
    if args.sample < 1:
        parser.error(f"--sample must be at least 1, got {args.sample}")
    return args


def _chosen(tree: Path, room: str, args: argparse.Namespace) -> list[Mutant]:
    """A room's mutants: all, or one at each of so many places."""
    everything = [m for file in ROOMS[room] for m in mutants_of(tree, file)]
    by_place: dict[tuple[str, int, int], list[Mutant]] = {}
    for mutant in everything:
        by_place.setdefault((mutant.file, mutant.line, mutant.column), []).append(mutant)
    of = f"{len(everything)} mutants of {len(by_place)} places"
    if args.all:
        print(f"{room}: all {of}", flush=True)
        return everything
    chance = random.Random(args.seed)
    drawn = chance.sample(sorted(by_place), min(args.sample, len(by_place)))
    print(f"{room}: a sample (seed {args.seed}), one mutant at each of {len(drawn)} places; in all {of}", flush=True)
    return [chance.choice(by_place[place]) for place in sorted(drawn)]


def _survivors(tree: Path, tried: list[Tried]) -> list[Mutant]:
    """Mutants that survived. Raises ValueError if one is no longer the same change."""
    survivors = [t for t in tried if t.verdict == SURVIVED]
    for t in survivors:
        if _change(tree, t.mutant) != (t.before, t.after):
            raise ValueError(f"{t.mutant.file} has changed since the results were written; run without --again")
    return [t.mutant for t in survivors]


def _try(runner: Runner, tree: Path, room: str, mutant: Mutant, reasons: Reasons) -> Tried:
    before, after = _change(tree, mutant)
    if (mutant.file, _without_spaces(before), _without_spaces(after)) in reasons:
        return Tried(mutant, before, after, EQUAL)
    killed = runner.killed(mutant, ROOMS[room][mutant.file])
    return Tried(mutant, before, after, KILLED if killed else SURVIVED)


def _change(tree: Path, mutant: Mutant) -> tuple[str, str]:
    return mutant.change((tree / mutant.file).read_text(encoding="utf-8"))


def known_equivalents() -> Reasons:
    """What `equivalent_mutants.json` names. Raises ValueError if a file has no such line."""
    reasons: Reasons = {}
    for entry in json.loads(EQUIVALENT.read_text(encoding="utf-8")):
        lines = {line.strip() for line in (ROOT / entry["file"]).read_text(encoding="utf-8").splitlines()}
        if entry["code"] not in lines:
            raise ValueError(f"{EQUIVALENT.name}: {entry['file']} has no line {entry['code']!r}")
        for mutant in entry["mutants"]:
            reasons[entry["file"], _without_spaces(entry["code"]), _without_spaces(mutant)] = entry["reason"]
    return reasons


def _without_spaces(line: str) -> str:
    return "".join(line.split())


def _progress(room: str, number: int, of: int, tried: Tried) -> None:
    where = f"{tried.mutant.file}:{tried.mutant.line} {tried.mutant.operator}"
    print(f"{time.strftime('%H:%M:%S')} {room} {number}/{of} {where}: {tried.verdict}", file=sys.stderr)


def report(results: Results) -> int:
    """Print the survivors and the table, and return the exit status."""
    for t in _of(results, SURVIVED):
        print(f"survived: {t.mutant.file}:{t.mutant.line} {t.mutant.operator}\n  - {t.before}\n  + {t.after}")
    print(f"{'room':<20}{'mutants':>8}{'killed':>8}{'survived':>10}{'equivalent':>12}{'share killed':>14}")
    shares = []
    for room, tried in results.items():
        killed, survived, equal = (sum(1 for _ in _of({room: tried}, verdict)) for verdict in VERDICTS)
        shares.append(killed / max(killed + survived, 1))
        print(f"{room:<20}{len(tried):>8}{killed:>8}{survived:>10}{equal:>12}{shares[-1]:>14.1%}")
    return int(min(shares) < LEAST_KILLED)


def _of(results: Results, verdict: str) -> Iterator[Tried]:
    return (t for tried in results.values() for t in tried if t.verdict == verdict)


def _read(file: Path) -> Results:
    rooms = json.loads(file.read_text(encoding="utf-8"))
    return {room: [Tried(**{**t, "mutant": Mutant(**t["mutant"])}) for t in tried] for room, tried in rooms.items()}


def _write(file: Path, results: Results) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    rows = {room: [asdict(t) for t in tried] for room, tried in results.items()}
    file.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
