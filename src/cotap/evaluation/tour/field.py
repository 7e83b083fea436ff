"""The figures that a public benchmark has published of others' policies, and ours beside them.

Source: https://github.com/rhoyn/teleop-walking-benchmark (README, September 2026).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from cotap.evaluation.report import interval


class Row(NamedTuple):
    """One policy, MuJoCo / PhysX; None where nothing is published."""

    policy: str
    survival_s: tuple[float, float]
    completed_percent: tuple[int, int]
    position_error_cm: tuple[int, int]
    yaw_error_deg: tuple[int, int]
    energy_kj: tuple[float | None, float | None] = (None, None)

    def cells(self) -> list[str]:
        """The name, and a cell for each of `COLUMNS`."""
        policy, *pairs = self
        return [policy, *("" if pair == (None, None) else " / ".join(map(_shown, pair)) for pair in pairs)]


ROBOT = "g1"
"""Whose policies these are."""
FIELD = (
    Row("gr00t_wbc, torso at 0.66 m", (85.2, 82.9), (80, 72), (17, 51), (8, 9), (7.3, 9.1)),
    Row("decoupled_wbc, torso at 0.66 m, pitch 0.12", (83.9, 81.5), (75, 68), (10, 20), (7, 6), (5.9, 13.1)),
    Row("gr00t_wbc, torso at 0.74 m", (80.2, 81.8), (63, 67), (13, 15), (5, 5), (7.9, 9.1)),
    Row("homie", (78.2, 79.0), (55, 58), (17, 18), (32, 36), (10.3, 9.3)),
    Row("amo", (75.9, 79.5), (54, 62), (24, 36), (17, 17), (10.0, 11.4)),
    Row("wbc_agile", (71.2, 67.1), (34, 27), (23, 39), (8, 10), (7.7, 8.0)),
    Row("sonic", (69.2, 54.0), (36, 15), (29, 44), (9, 12), (11.2, None)),
    Row("asap", (46.3, 45.3), (7, 8), (141, 129), (32, 35)),
    Row("falcon", (37.7, 40.2), (2, 4), (42, 49), (14, 16)),
    Row("rl_lab", (25.5, 23.2), (0, 0), (57, 68), (74, 76)),
    Row("holosoma", (5.9, 6.4), (0, 0), (73, 83), (48, 55)),
    Row("rl_mjlab", (5.6, 5.3), (0, 0), (243, 244), (62, 67)),
    Row("rl_gym", (1.2, 1.4), (0, 0), (100, 111), (81, 73)),
)
"""By mean survival over both engines."""


COLUMNS = {
    "survival_s": ("mean survival [s]", 1.0),
    "completed_fraction": ("completed [%]", 100.0),
    "position_error": ("position error [cm]", 100.0),
    "yaw_error": ("yaw error [deg]", 180.0 / math.pi),
    "energy": ("energy [kJ]", 1e-3),
}
"""Measures of an evaluation, each with the title of its column and how many of the column's units make one of its
own."""


def field_table(ours: dict[str, Any] | None = None) -> str:
    """The published figures as Markdown, with a result of ours as the first row if there is one."""
    rows = [["policy", *(title for title, _ in COLUMNS.values())], *([_own_cells(ours)] if ours else [])]
    head, *lines = (f"| {' | '.join(row)} |" for row in (*rows, *(row.cells() for row in FIELD)))
    return "\n".join([head, "|---" * len(rows[0]) + "|", *lines])


def beside_the_field(result: dict[str, Any]) -> str:
    """A result among the published figures; empty if it is of another robot, or not of the whole tour."""
    settings = result["settings"]
    whole = (settings["episode_seconds"], settings["waypoints"], settings["force_size"]) == (90.0, 18, 500.0)
    if settings["env"]["robot"] != ROBOT or not whole:
        return ""
    note = "Published figures: MuJoCo / PhysX, by https://github.com/rhoyn/teleop-walking-benchmark"
    return f"{field_table(result)}\n\n{note}."


def _own_cells(result: dict[str, Any]) -> list[str]:
    name = f"**this policy, {result['settings']['engine']}, arms {result['method']}**"
    return [name, *(_interval(result["metrics"][measure], scale) for measure, (_, scale) in COLUMNS.items())]


def _interval(measure: dict[str, Any], scale: float) -> str:
    if measure["mean"] is None:
        return ""
    return f"{scale * measure['mean']:.1f} ({interval(measure, 1, scale)})"


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:g}"
