"""Policies that act in environments other than their own."""

from __future__ import annotations

import pytest

from cotap.agents.checkpoint import CheckpointError
from cotap.evaluation.policy import load_policy, require_acting, shipped_checkpoint


def test_what_critics_saw_does_not_matter_to_a_policy_that_acts():
    path = shipped_checkpoint("h1-base")
    policy = load_policy(path)
    require_acting(path, policy, policy.layout | {"critic_terms": [["smell", 2, 1.0]]})
    with pytest.raises(CheckpointError, match="history"):
        require_acting(path, policy, policy.layout | {"history": 7})
