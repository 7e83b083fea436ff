"""What hands feel, in numbers: force, how far it has moved the hand, and the stiffness of that beside the one asked
for."""

from __future__ import annotations

import numpy as np

from cotap.play import ROBOTS
from cotap.play.plots import LEAST_N
from cotap.play.sample import Sample

LEAST_M = 0.003
"""A smaller displacement says nothing of stiffness [m]."""
NONE = "-"


class Readout:
    """Watches the hands of N robots step by step.

    Args:
        sides: Names of the H hands.
    """

    def __init__(self, sides: tuple[str, ...]) -> None:
        self._sides = sides
        self._last: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def clear(self) -> None:
        """Forget what was: hands have been put elsewhere."""
        self._last = None

    def take(self, sample: Sample) -> None:
        """Take note of one step."""
        force = np.einsum("nji,nhj->nhi", sample["heading_w"], sample["hand_force_w"])
        offset = np.einsum("nji,nhj->nhi", sample["heading_w"], sample["hand_w"] - sample["hand_reference_w"])
        size = np.linalg.norm(force, axis=2)
        loaded = size >= LEAST_N
        rest, felt, _ = self._last or (offset, np.full((*size.shape, 4), np.nan), loaded)
        # What moves a hand without a force is no give: it counts from where the hand was before the force came.
        rest[~loaded] = offset[~loaded]
        along = force / np.maximum(size, LEAST_N)[..., None]
        moved = ((offset - rest) * along).sum(2)
        stiffness = np.where(moved >= LEAST_M, size / np.maximum(moved, LEAST_M), np.nan)
        asked = 1.0 / np.maximum((along**2 / sample["commanded_stiffness"]).sum(2), 1e-9)
        felt[loaded] = np.stack((size, 100.0 * moved, stiffness, asked), 2)[loaded]
        self._last = rest, felt, loaded

    def table(self, count: int) -> str:
        """Markdown of a row for each hand of the first `count` robots; in brackets what the last force did."""
        lines = ["| hand | load [N] | moved [cm] | felt [N/m] | asked [N/m] |", "|---|---|---|---|---|"]
        last = self._last
        if last is None:
            return "\n".join(lines)
        _, felt, loaded = last
        for robot in range(min(count, len(felt))):
            for hand, side in enumerate(self._sides):
                name = f"{ROBOTS[robot].upper()} {side}" if count > 1 else side
                cells = [_cell(v, d, loaded[robot, hand]) for v, d in zip(felt[robot, hand], (1, 1, 0, 0), strict=True)]
                lines.append(f"| {name} | {' | '.join(cells)} |")
        return "\n".join(lines)


def _cell(value: float, digits: int, now: bool) -> str:
    if not np.isfinite(value):
        return NONE
    return f"{value:.{digits}f}" if now else f"({value:.{digits}f})"
