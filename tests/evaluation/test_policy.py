"""Policies that act in environments other than their own."""

from __future__ import annotations

import pytest

from cotap.agents.checkpoint import CheckpointError
from cotap.evaluation import policy
from cotap.evaluation.policy import find_policy, load_policy, require_acting, shipped_checkpoint, shipped_policy


def test_what_critics_saw_does_not_matter_to_a_policy_that_acts():
    path = shipped_checkpoint("h1-base")
    policy = load_policy(path)
    require_acting(path, policy, policy.layout | {"critic_terms": [["smell", 2, 1.0]]})
    with pytest.raises(CheckpointError, match="history"):
        require_acting(path, policy, policy.layout | {"history": 7})


@pytest.mark.parametrize(
    ("there", "robot", "stages", "found"),
    [
        (["h1-base", "h1-cotap"], "h1", ("cotap", "base"), "h1-cotap"),
        (["h1-base", "h1-cotap"], "h1", ("base",), "h1-base"),
        (["h1-cotap", "g1-base"], "g1", ("cotap", "base"), "g1-base"),
    ],
)
def test_a_robot_has_the_policy_that_ships_of_it(there, robot, stages, found, tmp_path, monkeypatch):
    monkeypatch.setattr(policy, "checkpoint_path", lambda name: tmp_path / name)
    for name in there:
        (tmp_path / name).touch()
    assert shipped_policy(robot, stages) == tmp_path / found
    if "base" in stages and len(stages) > 1:
        assert find_policy("", robot) == tmp_path / found


def test_of_a_robot_without_a_policy_it_is_said_what_ships(tmp_path, monkeypatch):
    monkeypatch.setattr(policy, "checkpoint_path", lambda name: tmp_path / name)
    (tmp_path / "h1-base").touch()
    with pytest.raises(ValueError, match="no policy of robot 'g1' is shipped; shipped are: h1-base"):
        find_policy("", "g1")
    with pytest.raises(ValueError, match="robot 'g2' is unknown"):
        find_policy("", "g2")
    assert find_policy("", "") == tmp_path / "h1-base"  # by default


def test_a_policy_of_another_robot_than_the_one_that_is_asked_for_is_refused(checkpoint):
    assert find_policy(str(checkpoint), "h1") == find_policy(str(checkpoint), "") == checkpoint
    with pytest.raises(ValueError, match="is of robot 'h1', not of 'g1'"):
        find_policy(str(checkpoint), "g1")
