"""Figure of docs/compliance.md: the path between two stiffness ellipsoids, log-Euclidean beside Euclidean."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch

from cotap.compliance import modulate_stiffness
from cotap.evaluation.report import pyplot, save_figure

STEPS = 7


def ellipse(stiffness: torch.Tensor, points: int = 121) -> torch.Tensor:
    """(points, 2) outline of the forces that a displacement of unit size meets."""
    angle = torch.linspace(0.0, 2.0 * torch.pi, points, dtype=stiffness.dtype)
    return torch.stack((angle.cos(), angle.sin()), 1) @ stiffness


def main() -> int:
    """Draw and write. Exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", nargs="?", type=Path, default=Path("docs/blend.png"))
    path = parser.parse_args().output
    plt = pyplot()

    turn = torch.tensor([[0.8, -0.6], [0.6, 0.8]], dtype=torch.float64)
    compliant = turn @ torch.diag(torch.tensor([1.0, 0.1], dtype=torch.float64)) @ turn.T
    pd = turn.T @ torch.diag(torch.tensor([1.0, 0.1], dtype=torch.float64)) @ turn
    figure, axes = plt.subplots(2, 1, figsize=(9.0, 3.9), constrained_layout=True)
    blends = (
        ("log-Euclidean: the determinant stays", modulate_stiffness),
        ("average of the entries: it swells", lambda a, b, t: t * a + (1.0 - t) * b),
    )
    for axis, (title, blend) in zip(axes, blends, strict=True):
        for i in range(STEPS):
            t = i / (STEPS - 1)
            k = blend(compliant, pd, t)
            outline = ellipse(k)
            color = plt.get_cmap("viridis")(0.1 + 0.75 * t)
            axis.fill(2.3 * i + outline[:, 0], outline[:, 1], color=color, alpha=0.75)
            axis.text(2.3 * i, -1.45, f"$\\alpha$ = {t:.2f}\ndet {float(torch.det(k)):.2f}", ha="center", fontsize=8)
        axis.set(title=title, aspect="equal", ylim=(-1.9, 1.1))
        axis.axis("off")
    save_figure(figure, path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
