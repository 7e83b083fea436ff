"""How much a measure changes from PD to a row under CoTaP, relative to PD, on one robot."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch

from reports.paper.arms import COMPLIANT
from reports.paper.book import Book, slug
from reports.paper.words import LABELS


def relative_change(
    before: Mapping[str, Sequence[float | None]],
    after: Mapping[str, Sequence[float | None]],
    measure: str,
    resamples: int = 1000,
) -> dict[str, Any]:
    """Mean after over mean before, less 1, with a bootstrap 95 % interval over envs; null with a reason without one.

    Args:
        before: Figures of every env by measure, null where an env has none, and whether it `stood`.
        after: The same of as many envs of the same seed.
        measure: One of the measures.
        resamples: Of the bootstrap, in which an env's two figures stay together.

    Returns:
        `mean`, `ci95` and `n`, the number of envs, those that stood in both.
    """
    old, new = (torch.tensor([math.nan if v is None else v for v in x[measure]]).double() for x in (before, after))
    stood = torch.tensor(before["stood"]).bool() & torch.tensor(after["stood"]).bool()
    both = torch.isfinite(old) & torch.isfinite(new) & stood
    old, new = old[both], new[both]
    n = len(old)
    if n < 2:
        return {"mean": None, "ci95": None, "n": n, "reason": "fewer than two envs stood in both"}
    draws = torch.randint(0, n, (resamples, n), generator=torch.Generator().manual_seed(0))
    changes = new[draws].mean(1) / old[draws].mean(1) - 1.0
    low, high = changes.quantile(torch.tensor([0.025, 0.975], dtype=torch.float64)).tolist()
    return {"mean": float(new.mean() / old.mean() - 1.0), "ci95": [low, high], "n": n}


def keep_changes(
    book: Book, mode: str, prefix: str, rows: Iterable[str] = COMPLIANT, measures: Iterable[str] = tuple(LABELS)
) -> None:
    """Put the changes of a mode into the book: of these rows under CoTaP, whose names begin with `prefix`."""
    pd = book.results.get(f"{prefix}-PD")
    found = {arms: book.results.get(f"{prefix}-{slug(arms)}") for arms in rows}
    if pd is not None:
        book.changes[mode] = {
            arms: {measure: relative_change(pd["per_env"], result["per_env"], measure) for measure in measures}
            for arms, result in found.items()
            if result is not None
        }


def keep_changes_of_sides(book: Book, mode: str, name: str, arms: str, measures: Iterable[str]) -> None:
    """The same of one evaluation, from its right arm, which is under PD, to its left one, under CoTaP."""
    if (result := book.results.get(name)) is not None:
        envs = result["per_env"]
        right, left = (envs | {m: envs[f"{m}_{side}"] for m in measures} for side in ("right", "left"))
        book.changes[mode] = {arms: {m: relative_change(right, left, m) for m in measures}}
