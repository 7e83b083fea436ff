"""Whether an arm of seven joints (G1) makes CoTaP's advantages over PD more pronounced than one of four (H1).

Writes docs/redundancy.md from what `reports.reproduce_paper` has measured on both robots.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from reports.paper.arms import COMPLIANT, mass
from reports.paper.book import row
from reports.paper.words import LABELS, hundredfold

BY_MASS = ", impulse by mass"
MODES = {mode + how: (mode, mode + how) for mode in ("stance", "walking") for how in ("", BY_MASS)}
"""Titles of the tables, with the mode of H1 and the mode of G1 that each compares."""
HEAD = """# Does a redundant arm make CoTaP's advantages more pronounced?

The paper expects so of a robot with more joints in its arms than H1's four, such as G1 with seven. It measured H1
alone. Written by `python -m reports.redundancy`: do not edit.

**{answer}**

A change is that of a measure from PD to CoTaP with the same policy, relative to PD, under the impact of
[H1's page](results.md) and [G1's](results_g1.md): negative is better. Its 95 % interval is a bootstrap over the envs
that stood under both. *More*: G1's change is lower than H1's, and the interval of the difference of the changes, from
theirs (square-and-add), does not hold zero; *less*: it is higher. Where CoTaP is worse than PD on both robots, *more*
means less of a disadvantage. The push is the same 25 N s on both, though G1 has {g1:.0f} kg and H1 {h1:.0f} kg; by
mass, G1's is smaller in proportion. With 95 % intervals, about one comparison in twenty says more or less by chance.
One training stands behind each policy, and the robots differ in more than their arms: gains, torque limits, legs."""


def verdict(h1: dict[str, Any], g1: dict[str, Any]) -> str:
    """`more`, `less` or `cannot be distinguished`, of two relative changes; or why there is none."""
    from cotap.compare import difference

    d = difference(h1, g1)
    if d["difference"] is None:
        return "not measured"
    low, high = d["ci95"]
    return "more" if high < 0.0 else "less" if low > 0.0 else "cannot be distinguished"


def read_changes(path: Path, robot: str) -> dict[str, Any]:
    """The changes in a robot's results.json. Raises ValueError where it is missing, foreign or without any."""
    command = f"python -m reports.reproduce_paper --robot {robot}"
    if not path.is_file():
        raise ValueError(f"there is no file {str(path)!r}; {command} writes it")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{str(path)!r} is not JSON: {error}") from error
    found = content.get("robot") if isinstance(content, dict) else None
    if found != robot:
        raise ValueError(f"{str(path)!r} must be of robot {robot!r}, got {found!r}")
    if not content.get("changes"):
        raise ValueError(f"{str(path)!r} has no changes from PD to CoTaP: {command} with the part impact measures them")
    return content["changes"]


def page(h1: dict[str, Any], g1: dict[str, Any]) -> str:
    """The page, from the changes of both robots by mode, arms and measure."""
    lines, verdicts = [], Counter()
    for title, (of_h1, of_g1) in MODES.items():
        lines += [
            "",
            f"## {title.capitalize()}",
            "",
            row("measure", "arms", "H1 [%]", "G1 [%]", "on G1"),
            "|---" * 5 + "|",
        ]
        for measure, name in LABELS.items():
            for arms in COMPLIANT:
                pair = [
                    changes.get(mode, {}).get(arms, {}).get(measure) for changes, mode in ((h1, of_h1), (g1, of_g1))
                ]
                found = verdict(*pair) if all(pair) else "not measured"
                verdicts[found] += 1
                lines.append(row(name.rpartition(" [")[0], arms, *map(hundredfold, pair), found))
    return "\n".join([HEAD.format(answer=answer(verdicts), h1=mass("h1"), g1=mass("g1")), *lines, ""])


def answer(verdicts: Counter[str]) -> str:
    """All verdicts in a sentence."""
    measured = verdicts.total() - verdicts["not measured"]
    return (
        f"Of {measured} comparisons {verdicts['more']} say more, {verdicts['less']} less, and "
        f"{verdicts['cannot be distinguished']} cannot be distinguished; {verdicts['not measured']} were not measured."
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Read both, write the page. Returns the exit status; bad input ends the program with 2."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--h1", type=Path, default=Path("docs/results/h1/results.json"), help="results.json of H1")
    parser.add_argument("--g1", type=Path, default=Path("docs/results/g1/results.json"), help="results.json of G1")
    parser.add_argument("--output", type=Path, default=Path("docs/redundancy.md"), help="the page")
    options = parser.parse_args(argv)
    from cotap.files import write_atomically

    try:
        text = page(read_changes(options.h1, "h1"), read_changes(options.g1, "g1"))
        write_atomically(options.output, lambda p: p.write_text(text, encoding="utf-8"))
    except (ValueError, OSError) as error:
        parser.error(str(error))
    print(f"written: {options.output}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
