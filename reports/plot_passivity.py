"""Figure of docs/passivity.md: energy along the two segments, and what a hand gives away with and without the store."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import Any

import torch

from cotap.compliance import EnergyStore, damping_energy, hold_back, spd_exp, spd_log, stiffness_energy
from cotap.evaluation.report import pyplot, save_figure

DT, SECONDS, SUBSTEPS = 0.02, 4.0, 20
MASS_KG, DAMPING, SOFT, STIFF = 1.0, 2.0, 100.0, 600.0
STORE = EnergyStore(first=1.0, ceiling=1.0)
DOUBLE = torch.float64


def segments() -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Shares, and the energy injected up to them along either segment, between two stiffnesses that are turned."""
    turn = torch.tensor([[math.cos(t := math.radians(21.0)), -math.sin(t)], [math.sin(t), math.cos(t)]], dtype=DOUBLE)
    old = torch.diag(torch.tensor([1000.0, 10.0], dtype=DOUBLE))
    new = turn @ torch.diag(torch.tensor([100.0, 1.0], dtype=DOUBLE)) @ turn.T
    error = 0.3 * torch.tensor([math.cos(1.466), math.sin(1.466)], dtype=DOUBLE)
    factor = torch.linalg.cholesky(old)
    ratio = spd_log(_symmetric(torch.linalg.solve(factor, torch.linalg.solve(factor, new).T)))
    curves: dict[str, list[torch.Tensor]] = {"log-Euclidean segment": [], "geodesic, as used": []}
    shares = torch.linspace(0.0, 1.0, 101, dtype=DOUBLE)
    for s in shares:
        mean = spd_exp(_symmetric((1.0 - s) * spd_log(old) + s * spd_log(new)))
        geodesic = _symmetric(factor @ spd_exp(s * ratio) @ factor.T)
        for curve, k in zip(curves.values(), (mean, geodesic), strict=True):
            curve.append(stiffness_energy(old, k, error))
    return shares, {name: torch.stack(curve) for name, curve in curves.items()}


def swing(filtered: bool) -> dict[str, list[float]]:
    """A hand of one kilogram on a spring: pushed for a fifth of a second, then braked, while its stiffness pumps."""
    x = v = before = drawn = 0.0
    k, level = torch.tensor([[SOFT]], dtype=DOUBLE), torch.tensor(STORE.first, dtype=DOUBLE)
    damping, rows = torch.tensor([[DAMPING]], dtype=DOUBLE), []
    for step in range(round(SECONDS / DT)):
        wanted = torch.full_like(k, STIFF if x * v < 0.0 else SOFT)
        if filtered:
            level = store_after_damping(level, damping, x - before)
            k, _, energy = hold_back(k, wanted, torch.tensor([-x], dtype=DOUBLE), STORE.available(level, DT))
            level = STORE.drawn(level, energy)
        else:
            k = wanted
        before = x
        for _ in range(SUBSTEPS):
            force = 4.0 if step < 10 else -5.0 * v
            v += DT / SUBSTEPS * (force - float(k) * x - DAMPING * v) / MASS_KG
            x += DT / SUBSTEPS * v
            drawn -= DT / SUBSTEPS * force * v
        rows.append((step * DT, drawn, float(wanted), float(k), float(level)))
    return dict(zip(("time", "drawn", "wanted", "stiffness", "level"), map(list, zip(*rows, strict=True)), strict=True))


def store_after_damping(level: torch.Tensor, damping: torch.Tensor, moved: float) -> torch.Tensor:
    """The level once the store has got its share of the last step's damping."""
    return STORE.filled(level, damping_energy(damping, torch.tensor([moved], dtype=DOUBLE), DT))


def _symmetric(m: torch.Tensor) -> torch.Tensor:
    return 0.5 * (m + m.T)


def draw(axes: Any) -> None:
    """Fill three axes."""
    shares, curves = segments()
    for (name, curve), color in zip(curves.items(), ("#d95f02", "#2171b5"), strict=True):
        axes[0].plot(shares, curve, color=color, label=name)
    axes[0].set(xlabel="share of the change", ylabel="energy injected [J]", ylim=(-0.2, 0.25))
    free, held = swing(False), swing(True)
    axes[1].plot(free["time"], free["drawn"], color="#d95f02", label="without")
    axes[1].plot(held["time"], held["drawn"], color="#2171b5", label="with the store")
    axes[1].axhline(STORE.first, color="k", ls="--", lw=0.8, label="first filling")
    axes[1].set(xlabel="time [s]", ylabel="energy drawn at the hand [J]", ylim=(-1.0, 4.0))
    axes[2].step(held["time"], held["wanted"], color="0.7", lw=0.8, where="post", label="asked for")
    axes[2].step(held["time"], held["stiffness"], color="#2171b5", where="post", label="in force")
    axes[2].set(xlabel="time [s]", ylabel="stiffness [N/m]", xlim=(0.0, 2.0))
    level = axes[2].twinx()
    level.step(held["time"], held["level"], color="#238b45", where="post", label="store")
    level.set(ylabel="store [J]", ylim=(0.0, 2.0))
    level.legend(frameon=False, fontsize=7, loc="upper right")
    for axis in axes:
        axis.grid(alpha=0.2)
        axis.legend(frameon=False, fontsize=7, loc="lower left" if axis is axes[0] else "upper left")


def main() -> int:
    """Draw and write. Exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", nargs="?", type=Path, default=Path("docs/passivity.png"))
    path = parser.parse_args().output
    plt = pyplot()

    figure, axes = plt.subplots(1, 3, figsize=(12.0, 3.2), constrained_layout=True)
    draw(axes)
    save_figure(figure, path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
