"""Worlds that fell and go on from a moment before."""

from __future__ import annotations

import copy
import math

import pytest
import torch

from cotap.compliance.laws import LawConfig
from cotap.envs.retries import Retries, RetryConfig, take_over
from cotap.envs.upper_body import UpperBody, UpperBodyConfig

EVERYONE = RetryConfig(share=1.0, every_s=0.1)


def leaves(state) -> list[torch.Tensor]:
    """All tensors, worlds first."""
    if isinstance(state, dict):
        pairs = [value.transpose(0, 1) for name, value in state.items() if name in UpperBody.PAIRED]
        return pairs + [leaf for name, value in state.items() if name not in UpperBody.PAIRED for leaf in leaves(value)]
    if isinstance(state, list):
        return [leaf for value in state for leaf in leaves(value)]
    return [state] if isinstance(state, torch.Tensor) else []


def knock_over(env, world: int) -> None:
    env.sim.qpos[world, 3:7] = torch.tensor([math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0])


def run(env, steps: int, seed: int = 0) -> torch.Tensor:
    """Observations and falls of `steps` of noisy standing, (steps, N, 431)."""
    rng, seen = torch.Generator().manual_seed(seed), []
    for _ in range(steps):
        action = 0.3 * torch.randn(env.num_envs, env.num_actions, generator=rng)
        obs, _, _, extras = env.step(action)
        seen.append(torch.cat((obs["policy"], extras["falls"].unsqueeze(1)), 1))
    return torch.stack(seen)


def test_only_the_rows_asked_for_are_taken_over():
    present = {"a": torch.zeros(4, 2), "b": [{"c": torch.zeros(4)}, torch.zeros(())], "n": 1, "other": torch.zeros(3),
               "_anchor": torch.zeros(2, 4)}  # fmt: skip
    past = {"a": torch.ones(4, 2), "b": [{"c": torch.arange(4.0)}, torch.ones(())], "n": 2, "other": torch.ones(3),
            "_anchor": torch.ones(2, 4)}  # fmt: skip
    take_over(present, past, torch.tensor([1, 3]), 4)
    assert present["a"].tolist() == [[0, 0], [1, 1], [0, 0], [1, 1]]
    assert present["b"][0]["c"].tolist() == [0, 1, 0, 3]
    assert (float(present["b"][1]), present["n"], present["other"].tolist()) == (0.0, 1, [0, 0, 0])
    assert present["_anchor"].tolist() == [[0, 1, 0, 1], [0, 1, 0, 1]]


def test_all_that_a_world_is_in_has_worlds_first(make_env):
    """Else `take_over` would leave something behind. Eleven is the number of nothing else."""
    shared = [leaf for leaf in leaves(make_env(11)._worlds()) if not (leaf.ndim and len(leaf) == 11)]
    assert all(leaf.ndim == 0 for leaf in shared)
    assert len(shared) == 2  # the assistance


def kept(n: int) -> Retries:
    """Of steps 5, 10, 15, and so on; at 22 now, nobody having fallen yet."""
    retries, rng = Retries(EVERYONE, n, 0.02), torch.Generator().manual_seed(0)
    nobody = torch.zeros(n, dtype=torch.bool)
    for step in range(1, 23):
        assert len(retries.draw(nobody, nobody, rng)[0]) == 0
        assert retries.due() == (step % 5 == 0)
        if retries.due():
            retries.keep({"step": torch.full((n,), step)})
    return retries


def test_falls_are_gone_back_by_one_to_four_intervals_and_never_beyond_the_last_start():
    n, rng = 3, torch.Generator().manual_seed(1)
    fell, gone_to = torch.tensor([True, True, False]), set()
    for _ in range(40):
        retries = kept(n)
        retries._begun = torch.tensor([0, 12, 0])
        ids, past = retries.draw(fell, fell, rng)
        step = int(past["step"][0])
        gone_to.add(step)
        assert ids.tolist() == ([0, 1] if step > 12 else [0])
        assert retries._begun.tolist() == [23, 23, 0]
    assert gone_to == {5, 10, 15}  # of 5, 10, 15, 20: the newest is within the fall


def test_the_share_of_the_falls_is_as_asked():
    n, rng = 4000, torch.Generator().manual_seed(1)
    everyone, retries = torch.ones(n, dtype=torch.bool), kept(n)
    retries._share = 0.3
    assert len(retries.draw(everyone, everyone, rng)[0]) / n == pytest.approx(0.3, abs=0.03)


@pytest.mark.parametrize("law", ["pd", "cotap"])
def test_a_world_that_falls_is_what_it_was_and_the_others_go_on(make_env, law):
    env = make_env(4, retries=EVERYONE, upper_body=UpperBodyConfig(LawConfig(law)))
    assert not run(env, 20)[..., -1].any()  # states are kept at 5, 10, 15, 20
    before = copy.deepcopy(list(env.retries._past))
    scale = torch.tensor([0.5, 0.6, 0.7, 0.8])
    env.hand_forces.scale = scale.clone()
    knock_over(env, 2)
    position = env.sim.qpos.clone()
    assert run(env, 1)[0, :, -1].tolist() == [0, 0, 1, 0]
    state = env._worlds()
    matches = [past for _, past in before if torch.equal(past["sim"]["state"][2], state["sim"]["state"][2])]
    assert len(matches) == 1
    past = matches[0]
    del state["parts"]["hand_forces"]["scale"], past["parts"]["hand_forces"]["scale"]
    for now, then in zip(leaves(state), leaves(past), strict=True):
        if now.ndim:
            assert torch.equal(now[2], then[2])
    assert torch.equal(env.state.joint_pos[2], env.sim.qpos[2, 7:].float())
    assert torch.equal(env.get_observations()["policy"][2], past["observations"]["policy"][2])
    # The fall takes 0.2 off the share of its world, and going back does not give it back.
    assert env.hand_forces.scale.tolist() == pytest.approx([0.5, 0.6, 0.5, 0.8])
    moved = (env.sim.qpos - position).abs().amax(1)
    assert float(moved[[0, 1, 3]].max()) < 0.2  # a step of standing, no restart
    assert env.episode_length_buf.tolist()[:2] == [21, 21]
    assert env.episode_length_buf[2] in (5, 10, 15)


def test_a_second_fall_soon_after_is_a_fresh_start(make_env):
    env = make_env(2, retries=EVERYONE)
    run(env, 20)
    for length in ((5, 10, 15), (0,)):
        knock_over(env, 1)
        assert run(env, 1)[0, 1, -1]
        assert env.episode_length_buf[1] in length


def test_nobody_goes_back_beyond_a_restart_of_all_worlds(make_env):
    env = make_env(2, retries=EVERYONE)
    run(env, 20)
    env.reset()
    knock_over(env, 1)
    assert run(env, 1)[0, 1, -1]
    assert env.episode_length_buf.tolist() == [1, 0]


def test_without_retries_nothing_is_kept(make_env):
    env = make_env(2)
    assert env.retries is None
    assert "retries" not in env.state_dict()


def test_a_run_with_retries_goes_on_exactly(make_env):
    env, other = (make_env(6, seed=s, retries=EVERYONE) for s in (0, 1))
    env.load_state_dict(make_env(6).state_dict())  # saved by a run without: nothing is kept yet
    run(env, 40)
    saved = copy.deepcopy(env.state_dict())
    knock_over(env, 3)
    future = run(env, 60, seed=1)
    assert future[..., -1].any()
    other.load_state_dict(saved)
    knock_over(other, 3)
    assert torch.equal(run(other, 60, seed=1), future)


@pytest.mark.parametrize("bad", [{"share": 1.5}, {"share": math.nan}, {"every_s": 0.0}])
def test_bad_fields_are_named(bad):
    with pytest.raises(ValueError, match=rf"retries\.{next(iter(bad))}"):
        RetryConfig(**bad).check()
