"""Evaluation with envs on a device that is not the CPU: the same numbers, nothing forgotten."""

from __future__ import annotations

from typing import Any

import pytest
from elsewhere import elsewhere

from cotap.evaluate import evaluate

COMPLIANT = ["--method", "cotap", "--num-envs", "2", "--threads", "1"]
PROTOCOLS = {
    "velocity-tracking": ["--num-envs", "2", "--threads", "1", "--episode-seconds", "5.0"],
    "fidelity": ["--threads", "1", "--num-envs", "3", "--stiffness-values", "200.0", "--settle-seconds", "2.0"],
    "stability": ["--method", "facet", "--threads", "1", "--poses", "2", "--num-envs", "2", "--episode-seconds", "0.2",
                  "--settle-seconds", "0.2", "--change-seconds", "0.1"],
    "static-stiffness": ["--method", "cotap", "--threads", "1", "--num-envs", "2",
                         "--levels", "2", "--settle-seconds", "2.0"],
    "tour": [*COMPLIANT, "--episode-seconds", "1.0", "--waypoints", "2"],
    "fall-curve": [*COMPLIANT, "--levels", "2", "--onset", "0.5", "--window", "0.0", "0.2", "--fall-seconds", "0.2",
                   "--episode-seconds", "0.8"],
    "modulation": [*COMPLIANT, "--onset", "0.5", "--window", "0.0", "0.2", "--fall-seconds", "0.2",
                   "--episode-seconds", "0.8"],
    "passivity": ["--compared", "cotap", "cotap:passive=true", "--num-envs", "40", "--generations", "1",
                  "--threads", "1", "--episode-seconds", "0.2", "--settle-seconds", "0.1"],
}  # fmt: skip
"""All but those that differ from one of these only in the force."""


@pytest.mark.slow
@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_evaluations_elsewhere_give_the_same(protocol, checkpoint, monkeypatch):
    args = [protocol, "--checkpoint", str(checkpoint), *PROTOCOLS[protocol]]
    here = evaluate(args)
    with elsewhere(monkeypatch.setattr):
        there = evaluate(args)
    for result in (here, there):
        result.pop("seconds")
    a, b = flat(here), flat(there)
    assert a.keys() == b.keys()
    for place, value in a.items():
        measured = isinstance(value, float)
        assert b[place] == (pytest.approx(value, rel=1e-3, abs=1e-6, nan_ok=True) if measured else value), place


def flat(tree: Any, at: str = "") -> dict[str, Any]:
    """Every leaf by its place; sums are taken in another order elsewhere, so digits need not agree."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else None
    if items is None:
        return {at: tree}
    return {k: v for key, value in items for k, v in flat(value, f"{at}.{key}").items()}
