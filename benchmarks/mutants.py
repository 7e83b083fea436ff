"""Changes the code a little, one place at a time, and counts how often the tests notice: `make mutants`.

A mutant that no test notices has survived: a behaviour that nothing asserts. All mutants of all rooms take many hours.
So a seeded sample of each room runs: places by chance, and at each one of its changes by chance. `--all` runs
everything. `--again` runs those once more that survived last time, in the file of results. Exit status 1 if fewer than
95 % of a room's mutants are killed.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import time
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path

from benchmarks.mutant_rooms import ROOMS
from benchmarks.mutant_rules import Mutant, mutants_of
from benchmarks.mutant_runs import Runner, copied_tree

ROOT = Path(__file__).resolve().parent.parent
EQUIVALENT = Path(__file__).with_name("equivalent_mutants.json")
LEAST_KILLED = 0.95
KILLED, SURVIVED, EQUAL = "killed", "survived", "equivalent"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", nargs="+", choices=ROOMS, default=list(ROOMS), metavar="ROOM", help=", ".join(ROOMS))
    parser.add_argument("--sample", type=int, default=60, metavar="N", help="places per room (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the sample (default: %(default)s)")
    parser.add_argument("--all", action="store_true", help="every mutant of every place")
    parser.add_argument("--again", action="store_true", help="only those that survived last time")
    parser.add_argument("--results", type=Path, default=ROOT / "runs/mutants.json", help="(default: %(default)s)")
    args = parser.parse_args()
    if args.sample < 1:
        parser.error(f"--sample must be at least 1, got {args.sample}")
    known = _known_equivalents()
    verdicts: dict[str, dict[Mutant, str]] = _read(args.results) if args.results.exists() else {}
    with copied_tree(ROOT) as tree:
        runner = Runner(tree)
        for room in args.rooms:
            chosen = (
                _survivors(verdicts, room)
                if args.again
                else _chosen(room, None if args.all else args.sample, args.seed)
            )
            found = verdicts.setdefault(room, {}) if args.again else {}
            for number, mutant in enumerate(chosen, 1):
                found[mutant] = _verdict(runner, room, mutant, known)
                _progress(room, number, len(chosen), mutant, found[mutant])
            verdicts[room] = found
            _write(args.results, verdicts)
    return _report({room: verdicts[room] for room in args.rooms})


def _chosen(room: str, places: int | None, seed: int) -> list[Mutant]:
    """A room's mutants: all, or one at each of so many places."""
    everything = [m for file in ROOMS[room] for m in mutants_of(ROOT, file)]
    by_place: dict[tuple[str, int, int], list[Mutant]] = {}
    for mutant in everything:
        by_place.setdefault((mutant.file, mutant.line, mutant.column), []).append(mutant)
    if places is None:
        print(f"{room}: all {len(everything)} mutants of {len(by_place)} places", flush=True)
        return everything
    chance = random.Random(seed)
    drawn = chance.sample(sorted(by_place), min(places, len(by_place)))
    print(
        f"{room}: a sample, {len(drawn)} of {len(by_place)} places (seed {seed}), one mutant at each; "
        f"{len(everything)} mutants in all",
        flush=True,
    )
    return [chance.choice(by_place[place]) for place in sorted(drawn)]


def _survivors(verdicts: dict[str, dict[Mutant, str]], room: str) -> list[Mutant]:
    return [mutant for mutant, verdict in verdicts.get(room, {}).items() if verdict == SURVIVED]


def _verdict(runner: Runner, room: str, mutant: Mutant, known: dict[tuple[str, str, str], str]) -> str:
    if (mutant.file, *map(_without_spaces, _change(mutant))) in known:
        return EQUAL
    return KILLED if runner.killed(mutant, ROOMS[room][mutant.file]) else SURVIVED


def _change(mutant: Mutant) -> tuple[str, str]:
    return mutant.change((ROOT / mutant.file).read_text(encoding="utf-8"))


def _known_equivalents() -> dict[tuple[str, str, str], str]:
    """Why a mutant changes nothing, by file, line and mutated line. Raises ValueError if a file has no such line."""
    reasons: dict[tuple[str, str, str], str] = {}
    for entry in json.loads(EQUIVALENT.read_text(encoding="utf-8")):
        lines = {line.strip() for line in (ROOT / entry["file"]).read_text(encoding="utf-8").splitlines()}
        if entry["code"] not in lines:
            raise ValueError(f"{EQUIVALENT.name}: {entry['file']} has no line {entry['code']!r}")
        for mutant in entry["mutants"]:
            reasons[entry["file"], _without_spaces(entry["code"]), _without_spaces(mutant)] = entry["reason"]
    return reasons


def _without_spaces(line: str) -> str:
    return "".join(line.split())


def _progress(room: str, number: int, of: int, mutant: Mutant, verdict: str) -> None:
    stamp = time.strftime("%H:%M:%S")
    where = f"{mutant.file}:{mutant.line} {mutant.operator}"
    print(f"{stamp} {room} {number}/{of} {where}: {verdict}", file=sys.stderr)


def _report(verdicts: dict[str, dict[Mutant, str]]) -> int:
    """Print the survivors and the table, and return the exit status."""
    for room in verdicts:
        for mutant in _survivors(verdicts, room):
            before, after = _change(mutant)
            print(f"survived: {mutant.file}:{mutant.line} {mutant.operator}\n  - {before}\n  + {after}")
    print(f"{'room':<20}{'mutants':>8}{'killed':>8}{'survived':>10}{'equivalent':>12}{'share killed':>14}")
    shares = []
    for room, found in verdicts.items():
        killed, survived, equal = (_count(found.values(), v) for v in (KILLED, SURVIVED, EQUAL))
        shares.append(killed / max(killed + survived, 1))
        print(f"{room:<20}{len(found):>8}{killed:>8}{survived:>10}{equal:>12}{shares[-1]:>14.1%}")
    return int(min(shares) < LEAST_KILLED)


def _count(verdicts: Iterable[str], which: str) -> int:
    return sum(verdict == which for verdict in verdicts)


def _read(file: Path) -> dict[str, dict[Mutant, str]]:
    rooms = json.loads(file.read_text(encoding="utf-8"))
    return {room: {Mutant(**m["mutant"]): m["verdict"] for m in found} for room, found in rooms.items()}


def _write(file: Path, verdicts: dict[str, dict[Mutant, str]]) -> None:
    rows = {r: [{"mutant": asdict(m), "verdict": v} for m, v in found.items()] for r, found in verdicts.items()}
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
