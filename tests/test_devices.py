"""Training and evaluation with worlds on a device that is not the processor: the same numbers, nothing forgotten."""

from __future__ import annotations

import json

import pytest
from elsewhere import elsewhere

from cotap.evaluate import evaluate

COMPLIANT = ["--method", "cotap", "--num-envs", "4", "--threads", "1"]
PROTOCOLS = {
    "velocity-tracking": ["--num-envs", "4", "--threads", "1", "--episode-seconds", "5.0"],
    "static-stiffness": ["--method", "cotap", "--threads", "1", "--pelvis", "free", "--levels", "3",
                         "--settle-seconds", "2.0"],
    "fidelity": ["--threads", "1", "--poses", "2", "--stiffness-levels", "200.0", "--settle-seconds", "2.0"],
    "stability": ["--method", "facet", "--threads", "1", "--poses", "4", "--num-envs", "4", "--seconds", "0.4",
                  "--settle-seconds", "0.4", "--change-seconds", "0.1"],
    "impact": [*COMPLIANT, "--episode-seconds", "2.0"],
    "periodic-load": ["--num-envs", "4", "--threads", "1", "--episode-seconds", "2.0", "--onset", "0.5",
                      "--window", "0.0", "1.0"],
    "punches": [*COMPLIANT, "--episode-seconds", "2.0"],
    "fall-curve": [*COMPLIANT, "--levels", "2", "--window", "0.0", "0.5", "--episode-seconds", "1.6"],
    "modulation": [*COMPLIANT, "--window", "0.0", "0.5", "--episode-seconds", "1.6"],
}  # fmt: skip


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_evaluations_elsewhere_give_the_same(protocol, monkeypatch):
    args = [protocol, *PROTOCOLS[protocol]]
    here = evaluate(args)
    with elsewhere(monkeypatch.setattr):
        there = evaluate(args)
    for result in (here, there):
        result.pop("seconds")
    assert json.dumps(here) == json.dumps(there)
