"""Live plots: the last seconds of what matters."""

from __future__ import annotations

from collections import deque
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
import viser
from viser import uplot

from cotap.play import ROBOTS
from cotap.play.sample import Sample

SECONDS = 10.0
"""What is shown [s]."""
EVERY = 2
"""Every how many control steps a point is plotted."""
COLORS = {("a", "left"): "#1f77b4", ("a", "right"): "#17becf", ("b", "left"): "#d62728", ("b", "right"): "#ff9896"}
LEAST_N = 2.0
"""A smaller force's displacement says nothing of stiffness [N]."""
Points = tuple[np.ndarray, ...]


def _column(samples: list[Sample], name: str, *index: int) -> np.ndarray:
    return np.array([s[name][index] for s in samples], dtype=np.float64)


def hand_errors(samples: list[Sample], robot: int, hand: int) -> np.ndarray:
    """(T,) distance of a hand from its reference [mm]."""
    return 1e3 * _column(samples, "hand_error", robot, hand)


def arm_torques(samples: list[Sample], robot: int, hand: int) -> np.ndarray:
    """(T,) 2-norm of an arm's torques [Nm]."""
    torque = np.array([s["arm_torque"][robot] for s in samples], dtype=np.float64)
    arms = samples[0]["hand_error"].shape[1]
    return np.linalg.norm(torque.reshape(len(samples), arms, -1)[:, hand], axis=1)


def force_displacement(samples: list[Sample], robot: int, hand: int) -> tuple[np.ndarray, np.ndarray]:
    """Force on a hand (P,) [N] against how far its hand is from its reference along it (P,) [mm], by displacement."""
    force = np.array([s["hand_force_w"][robot, hand] for s in samples], dtype=np.float64)
    offset = np.array([s["hand_w"][robot, hand] - s["hand_reference_w"][robot, hand] for s in samples])
    size = np.linalg.norm(force, axis=1)
    on = size > LEAST_N
    along = 1e3 * (offset[on] * force[on]).sum(1) / size[on]
    order = np.argsort(along)
    return size[on][order], along[order]


def plots_tab(server: viser.ViserServer) -> viser.GuiTabHandle:
    """Where plots go: a panel below that of the controls, so that both are seen at once.

    It is its only tab: a plot that is made while it is hidden has no width.
    """
    panel = server.gui.add_panel()
    panel.dock_below(server.gui.main_panel)
    return panel.add_tab("Plots")


class Plots:
    """Seven plots, made when there is something to plot.

    Args:
        server: The page.
        container: The tab or folder that they are in.
        sides: Arms.
        dt: Control step [s].
    """

    TITLES = ("hand error", "arm torque", "torso velocity", "eigenvalues of K", "energy store",
              "share of a change of K held back", "force and displacement along it")  # fmt: skip
    AXES = (("time [s]", "mm"), ("time [s]", "Nm"), ("time [s]", "m/s"), ("time [s]", "Nm/rad"), ("time [s]", "J"),
            ("time [s]", "share"), ("mm", "N"))  # fmt: skip
    """Labels of x and y."""

    def __init__(
        self, server: viser.ViserServer, container: AbstractContextManager[Any], sides: tuple[str, ...], dt: float
    ) -> None:
        self._gui, self._container, self._sides, self._dt = server.gui, container, sides, dt
        self._history: deque[tuple[int, Sample]] = deque(maxlen=round(SECONDS / dt / EVERY))
        self._sets: dict[int, list[viser.GuiUplotHandle]] = {}
        self._count = 0

    def append(self, step: int, sample: Sample) -> None:
        """Take note of control step number `step`."""
        if step % EVERY == 0:
            self._history.append((step, sample))

    def clear(self) -> None:
        """Forget what was."""
        self._history.clear()

    def draw(self, count: int) -> None:
        """Bring the plots up to date, for this many robots."""
        history = list(self._history)
        if len(history) < 2:
            return
        lines = self._lines(history, count)
        if count != self._count:
            self._change(lines, count)
            return
        for handle, points in zip(self._sets[count], lines, strict=True):
            handle.data = points

    def _change(self, lines: list[Points], count: int) -> None:
        """Show the plots for this many robots. Those for other numbers are hidden, not removed: browsers may still
        have an update of theirs to come."""
        if count not in self._sets:
            with self._container:
                self._sets[count] = self._build(lines, count)
        for number, handles in self._sets.items():
            for handle in handles:
                handle.visible = number == count
        self._count = count

    def _lines(self, history: list[tuple[int, Sample]], count: int) -> list[Points]:
        samples = [s for _, s in history]
        time = self._dt * np.array([step for step, _ in history], dtype=np.float64)
        pairs = [(r, h) for r in range(count) for h in range(len(self._sides))]
        velocity = [_column(samples, "velocity", r, 0) for r in range(count)]
        eigenvalues = [_column(samples, "stiffness_eigenvalues", r, h, i) for r, h in pairs for i in (0, 1)]
        return [
            (time, *(hand_errors(samples, *p) for p in pairs)),
            (time, *(arm_torques(samples, *p) for p in pairs)),
            (time, *velocity, _column(samples, "command", 0, 0), _column(samples, "velocity", 0, 1),
             _column(samples, "command", 0, 1)),
            (time, *eigenvalues),
            *((time, *(_column(samples, name, *p) for p in pairs)) for name in ("store_energy", "held_back")),
            _scatter([force_displacement(samples, *p) for p in pairs]),
        ]  # fmt: skip

    def _build(self, lines: list[Points], count: int) -> list[viser.GuiUplotHandle]:
        pairs = [(r, side) for r in ROBOTS[:count] for side in self._sides]
        label = {(r, side): side if count == 1 else f"{r.upper()} {side}" for r, side in pairs}
        hands = [_line(label[p], COLORS[p]) for p in pairs]
        torso = [_line(f"forward {r.upper()}" if count > 1 else "forward", COLORS[r, "left"]) for r in ROBOTS[:count]]
        torso += [
            _line("asked", "#888888", dash=True), _line("leftward", "#9467bd"), _line("asked", "#bbbbbb", dash=True)
        ]  # fmt: skip
        ends = [_line(f"{label[p]} {end}", COLORS[p], dash=end == "min") for p in pairs for end in ("min", "max")]
        dots = [_line(label[p], COLORS[p], dots=True) for p in pairs]
        return [
            self._gui.add_uplot(
                points, (uplot.Series(label=x), *series), title=title, height=190,
                axes=(uplot.Axis(label=x), uplot.Axis(label=y)), scales={"x": uplot.Scale(time=False)},
                legend=uplot.Legend(live=False),
            )
            for title, (x, y), points, series in zip(
                self.TITLES, self.AXES, lines, (hands, hands, torso, ends, hands, hands, dots), strict=True
            )
        ]  # fmt: skip


def _line(label: str, color: str, dash: bool = False, dots: bool = False) -> uplot.Series:
    series = uplot.Series(label=label, stroke=color, width=0.0 if dots else 1.5)
    if dash:
        series["dash"] = (5.0, 4.0)
    series["points"] = {"show": dots, "size": 4.0, "fill": color}
    return series


def _scatter(sets: list[tuple[np.ndarray, np.ndarray]]) -> Points:
    """Sets of (y, x) on one ascending x axis from 0; a set has gaps (NaN) where only others have points."""
    x = np.concatenate([np.zeros(1), *(along for _, along in sets)])
    rows = []
    start = 1
    for force, along in sets:
        y = np.full_like(x, np.nan)
        y[0] = 0.0
        y[start : start + len(along)] = force
        rows.append(y)
        start += len(along)
    order = np.argsort(x, kind="stable")
    return x[order], *(row[order] for row in rows)
