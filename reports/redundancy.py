"""Whether an arm of seven joints (G1) makes CoTaP's advantages over PD more pronounced than one of four (H1), and why.

Writes docs/redundancy.md from what `reports.reproduce_paper` has measured on both robots.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from cotap import robots
from reports.paper import constant_load, periodic
from reports.paper.arms import COMPLIANT
from reports.paper.book import row
from reports.paper.words import LABELS, hundredfold, number

ROBOTS = ("h1", "g1")
BY_MASS = ", impulse by mass"
NAMES = {measure: label.rpartition(" [")[0] for measure, label in LABELS.items()} | periodic.CHANGING


class Table(NamedTuple):
    """Changes of one test."""

    modes: tuple[str, str]
    """Under which H1's and G1's are kept."""
    measures: tuple[str, ...]
    arms: tuple[str, ...]


TABLES = {
    f"impact, {mode}{how}": Table((mode, mode + how), tuple(LABELS), COMPLIANT)
    for mode in ("stance", "walking")
    for how in ("", BY_MASS)
} | {
    constant_load.MODE: Table(
        (constant_load.MODE, constant_load.MODE), constant_load.CHANGING, constant_load.COMPLIANT
    ),
    periodic.MODE: Table((periodic.MODE, periodic.MODE), tuple(periodic.CHANGING), (periodic.ARMS,)),
}  # fmt: skip
"""By title."""
VERDICTS = ("more", "less", "cannot be distinguished", "not measured")
ROWS = {
    "impact, stance, K 100": ("impact-stance-K-100", ""),
    "impact, walking, K 100": ("impact-walking-K-100", ""),
    "constant load, K_z 100": ("load-K-z-100", ""),
    "periodic load, left arm": ("periodic", "_left"),
}
"""Rows of the table of causes: names of evaluations, and what ends those of their measures."""
CAUSES = {
    "condition_number": ("condition number of the hand's Jacobian", number),
    "singular_share": ("share of time above 10 [%]", hundredfold),
    "null_share": ("share of the compliance in the null space [%]", hundredfold),
}
"""Measures that may say why, with their names and how they are shown."""
HEAD = """# Does a redundant arm make CoTaP's advantages more pronounced?

The paper expects so of a robot with more joints in its arms than H1's four, such as G1 with seven. It measured H1
alone. Written by `python -m reports.redundancy`: do not edit.

**{answer}**

A change is that of a measure from PD to CoTaP with the same policy, relative to PD, in the tests of [H1's
page](results.md) and [G1's](results_g1.md): negative is better. Its 95 % interval, of which the larger half stands
after ±, is a bootstrap over the envs that stood under both: on G1, under full pushes, hardly half of them. *More*: G1's
change is lower than H1's, and the interval of the difference of the changes, from theirs (square-and-add), does not
hold zero; *less*: it is higher; no word: they cannot be distinguished. Cells have H1's change and G1's in percent.
Where CoTaP is worse than PD on both robots, *more* means less of a disadvantage. Forces are the same on both, though G1
has {g1:.0f} kg and H1 {h1:.0f} kg; by mass, G1's push is smaller in proportion. Under the periodic load, both arms are
those of one robot, the left under CoTaP, the right under PD. With 95 % intervals, about one comparison in twenty says
more or less by chance. One training stands behind each policy, and the robots differ in more than their arms: gains,
torque limits, legs.

## On which measures"""
WHY = """## Why

What differs between the arms, in the measured time, over the envs that stood. Where the condition number is above 10,
an arm is so near to singular that compliance gives way to PD; numbers above 50 count as 50. The null space is motion of
the joints that leaves the hand where it is: one direction on H1, four on G1. Its share is that of the trace of the
joints' compliance matrix; under PD with equal gains it is 25 % with four joints and 57 % with seven. Less time above 10
leaves more of the compliance that was asked for, and a larger share of the null space lets joints yield whose torque
does nothing for the hand. Where both hold and a measure is not more pronounced, something else decides it."""


def verdict(h1: dict[str, Any], g1: dict[str, Any], lower: str = "more", higher: str = "less") -> str:
    """Whether G1's is `lower` or `higher` than H1's, of two changes or measures, or `cannot be distinguished`; or why
    there is none."""
    from cotap.compare import difference

    d = difference(h1, g1)
    if d["difference"] is None:
        return "not measured"
    low, high = d["ci95"]
    return lower if high < 0.0 else higher if low > 0.0 else "cannot be distinguished"


def read_results(path: Path, robot: str) -> dict[str, Any]:
    """A robot's results.json. Raises ValueError where it is missing, foreign or without any changes."""
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
    return content


def page(h1: dict[str, Any], g1: dict[str, Any]) -> str:
    """The page, from what was measured on both robots."""
    lines: list[str] = []
    verdicts = {name: Counter[str]() for name in NAMES.values()}
    for title, table in TABLES.items():
        columns = [NAMES[measure] for measure in table.measures]
        lines += ["", f"## {title.capitalize()}", "", stood(h1, g1, table)]
        lines += ["", row("arms", *columns), "|---" * (1 + len(columns)) + "|"]
        for arms in table.arms:
            cells = []
            for measure in table.measures:
                pair = [
                    content["changes"].get(mode, {}).get(arms, {}).get(measure)
                    for content, mode in zip((h1, g1), table.modes, strict=True)
                ]
                found = verdict(*pair) if all(pair) else "not measured"
                verdicts[NAMES[measure]][found] += 1
                cells.append(compared(pair, found))
            lines.append(row(arms, *cells))
    total = sum(verdicts.values(), Counter[str]())
    weights = {name: robots.ROBOTS[name]().mass_kg for name in ROBOTS}
    counts = [row(name, *(str(found[v]) for v in VERDICTS)) for name, found in verdicts.items()]
    head = [HEAD.format(answer=answer(total), **weights), "", row("measure", *VERDICTS), "|---" * 5 + "|", *counts]
    return "\n".join([*head, "", WHY, *causes(h1, g1), *lines, ""])


def stood(h1: dict[str, Any], g1: dict[str, Any], table: Table) -> str:
    """How many robots stood under both laws: fewer on the robot that falls more, and those that others fell beside."""
    counts = []
    for name, content, mode in zip(ROBOTS, (h1, g1), table.modes, strict=True):
        found = [change["n"] for arms in content["changes"].get(mode, {}).values() for change in arms.values()]
        counts.append(f"{name.upper()} {min(found)} to {max(found)}" if found else f"{name.upper()} not measured")
    envs = {row["num_envs"] for content in (h1, g1) for row in content.get("rows", {}).values() if "num_envs" in row}
    of = f", of {min(envs)}" if len(envs) == 1 else ""
    return f"Robots that stood under both laws{of}: {', '.join(counts)}."


def compared(pair: list[dict[str, Any] | None], found: str) -> str:
    """H1's change, G1's, and the verdict where there is one of two."""
    if found == "not measured":
        return found
    mark = {"more": ", **more**", "less": ", *less*"}.get(found, "")
    return f"{hundredfold(pair[0])} / {hundredfold(pair[1])}{mark}"


def causes(h1: dict[str, Any], g1: dict[str, Any]) -> list[str]:
    """The table of what may say why."""
    lines = ["", row("figure", "test", "H1", "G1", "on G1"), "|---" * 5 + "|"]
    for measure, (name, shown) in CAUSES.items():
        for title, (key, suffix) in ROWS.items():
            pair = [
                content.get("rows", {}).get(key, {}).get("metrics_without_falls", {}).get(measure + suffix)
                for content in (h1, g1)
            ]
            found = verdict(*pair, lower="lower", higher="higher") if all(pair) else "not measured"
            lines.append(row(name, title, *map(shown, pair), found))
    return lines


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
    for robot in ROBOTS:
        default = Path(f"docs/results/{robot}/results.json")
        parser.add_argument(f"--{robot}", type=Path, default=default, help=f"results.json of {robot.upper()}")
    parser.add_argument("--output", type=Path, default=Path("docs/redundancy.md"), help="the page")
    options = parser.parse_args(argv)
    from cotap.files import write_atomically

    try:
        text = page(*(read_results(getattr(options, robot), robot) for robot in ROBOTS))
        write_atomically(options.output, lambda p: p.write_text(text, encoding="utf-8"))
    except (ValueError, OSError) as error:
        parser.error(str(error))
    print(f"written: {options.output}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
