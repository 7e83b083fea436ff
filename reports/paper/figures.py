"""Figures of the page."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from cotap.evaluation.report import pyplot
from reports.paper.book import Book

Shot = tuple[str, list[str], tuple[float, ...]]
"""What is in a picture, the arguments of its evaluation, and when it is taken [s]."""


def plot_curves(path: Path, curves: dict[str, tuple[list[float], list[float]]], x: str, y: str) -> None:
    """Several curves on one axis."""
    figure, axis = _axes(1)
    for name, (time, values) in curves.items():
        if time:
            axis[0].plot(time, values, label=name)
    axis[0].axvline(0.0, color="0.6", lw=0.8)
    _finish(path, figure, axis[0], xlabel=x, ylabel=y)


def plot_trade_off(path: Path, points: list[tuple[str, float, float]]) -> None:
    """Error of single hands' felt stiffness [%] against e_upper [rad], by the share of the policy's arm actions."""
    figure, axis = _axes(1)
    axis[0].plot([x for _, x, _ in points], [y for *_, y in points], "o-", color="#2171b5")
    for share, x, y in points:
        axis[0].annotate(share, (x, y), textcoords="offset points", xytext=(5, 5))
    labels = {"xlabel": "e_upper [rad]", "ylabel": "error of the felt stiffness, 95 % of hands within [%]"}
    _finish(path, figure, axis[0], **labels)


def draw_pictures(book: Book, name: str, caption: str, shots: Iterable[Shot]) -> None:
    """A row of pictures of robots."""
    from cotap.evaluate import pictures
    from cotap.evaluation.report import save_figure

    images = []
    for label, args, times in shots:
        shown, fell_s = pictures(args, times)
        for time, image in zip(times, shown, strict=True):
            when = f"{time:g} s" if time < fell_s else f"fell after {fell_s:.2f} s"
            images.append((f"{label} {when}".strip(), image))
    figure, axes = _axes(len(images), (2.6 * len(images), 2.9))
    for axis, (label, image) in zip(axes, images, strict=True):
        axis.imshow(image)
        axis.set_title(label, fontsize=10)
        axis.axis("off")
    save_figure(figure, book.figure(name, caption))


def _axes(columns: int, size: tuple[float, float] = (7.5, 4.2)) -> tuple[Any, Any]:
    plt = pyplot()

    figure, axes = plt.subplots(1, columns, figsize=size, constrained_layout=True, squeeze=False)
    return figure, axes[0]


def _finish(path: Path, figure: Any, axis: Any, **labels: Any) -> None:
    from cotap.evaluation.report import save_figure

    axis.set(**labels)
    axis.grid(alpha=0.2)
    if axis.get_legend_handles_labels()[0]:
        axis.legend(frameon=False)
    save_figure(figure, path)
