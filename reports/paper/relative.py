"""How much a measure changes from PD to a row under CoTaP, relative to PD, on one robot."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
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


def keep_changes(book: Book, mode: str, prefix: str) -> None:
    """Put the changes of a mode into the book: of all rows under CoTaP whose names begin with `prefix`."""
    pd = book.results.get(f"{prefix}-PD")
    rows = {arms: book.results.get(f"{prefix}-{slug(arms)}") for arms in COMPLIANT}
    if pd is not None:
        book.changes[mode] = {
            arms: {measure: relative_change(pd["per_env"], result["per_env"], measure) for measure in LABELS}
            for arms, result in rows.items()
            if result is not None
        }
