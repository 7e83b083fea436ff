"""Symmetric networks: against mirrored inputs, a plain network, and in the learner."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
import torch
from dummy_env import TINY, DummyEnv
from random_policy import save_random_policy

from cotap.agents.actors import AgentLayout, DualActorCritic, Observations
from cotap.agents.checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from cotap.agents.dual_ppo import DualPPO, DualPPOConfig
from cotap.agents.heads import Head, SymmetricHead
from cotap.agents.parity import Parity
from cotap.agents.runner import layout_of
from cotap.evaluation.policy import load_policy
from cotap.reflection import Reflection, Symmetry, join

SWAP = Reflection(torch.tensor([1, 0, 2]), torch.tensor([1.0, 1.0, -1.0]))


def dummy_symmetry() -> Symmetry:
    """Actions 0 and 1 change places, the others change sign; observations in reverse order, or with another sign."""
    return Symmetry(
        {
            "policy": Reflection(torch.arange(5, -1, -1), torch.ones(6)),
            "privileged": Reflection(torch.tensor([0, 1]), torch.tensor([-1.0, 1.0])),
        },
        Reflection(torch.tensor([1, 0, 2, 3, 4]), torch.tensor([1.0, 1.0, -1.0, -1.0, -1.0])),
    )


def symmetric_layout() -> AgentLayout:
    return dataclasses.replace(layout_of(DummyEnv(8)), symmetry=dummy_symmetry())


def observations(n: int, seed: int) -> Observations:
    rng = torch.Generator().manual_seed(seed)
    return {"policy": 5.0 + 3.0 * torch.randn(n, 6, generator=rng), "privileged": torch.randn(n, 2, generator=rng)}


def mirrored(x: Observations) -> Observations:
    return {group: dummy_symmetry().observations[group](value) for group, value in x.items()}


@pytest.mark.parametrize("hidden", [(2,), (8, 4), (16, 8, 4)])
def test_mirrored_inputs_give_mirrored_outputs(hidden: tuple[int, ...]):
    torch.manual_seed(0)
    head = SymmetricHead(SWAP, SWAP, hidden, 1.0)
    torch.nn.init.normal_(head.output_bias)
    x = torch.randn(7, 3)
    split = head.parity
    assert head(split(x)).std() > 0.1
    torch.testing.assert_close(head(split(SWAP(x))), SWAP(head(split(x))))


def test_one_hidden_pair_by_hand():
    """Units w.x + b and w.Mx + b of x = (1, 2, 3), Mx = (2, 1, -3); outputs C h + M C swapped h + (b + M b) / 2."""
    head = SymmetricHead(SWAP, SWAP, (2,), 1.0)
    with torch.no_grad():
        head.weights[0].copy_(torch.tensor([[1.0, 2.0, 0.5]]))
        head.biases[0].fill_(0.25)
        head.output_weight.copy_(torch.tensor([[1.0], [10.0], [100.0]]))
        head.output_bias.copy_(torch.tensor([1.0, 3.0, 7.0]))
    silu = torch.nn.functional.silu
    a, b = silu(torch.tensor(1.0 + 4.0 + 1.5 + 0.25)), silu(torch.tensor(2.0 + 2.0 - 1.5 + 0.25))
    expected = torch.stack((a + 10.0 * b + 2.0, 10.0 * a + b + 2.0, 100.0 * (a - b)))
    split = torch.tensor([[1.5, -0.5, 3.0]])  # (1 + 2) / 2; (1 - 2) / 2 and what is its own image's negative
    torch.testing.assert_close(head(split)[0], expected)


def test_the_even_part_is_kept_by_mirroring_and_the_odd_one_changes_sign():
    """Columns 0 and 3 change places, 1 and 4 with another sign, too; 2 is its own image, 5 its own image's negative."""
    reflection = Reflection(torch.tensor([3, 4, 2, 0, 1, 5]), torch.tensor([1.0, -1.0, 1.0, 1.0, -1.0, -1.0]))
    split = Parity(reflection)
    x = torch.tensor([[1.0, 10.0, 100.0, 3.0, 30.0, 300.0]])
    torch.testing.assert_close(split(x), torch.tensor([[2.0, -10.0, 100.0, -1.0, 20.0, 300.0]]))
    torch.testing.assert_close(split(reflection(x)), torch.tensor([[2.0, -10.0, 100.0, 1.0, -20.0, -300.0]]))
    rng = torch.Generator().manual_seed(0)
    weight, many = torch.randn(4, 6, generator=rng), torch.randn(5, 6, generator=rng)
    even, odd = split.weights(weight)
    assert (even.shape, odd.shape) == ((4, 3), (4, 3))
    torch.testing.assert_close(split(many) @ torch.cat((even, odd), 1).T, many @ weight.T)


def test_groups_are_read_as_if_they_were_split_together():
    model = DualActorCritic(symmetric_layout(), (4,), 1.0).eval()
    x = observations(5, 3)
    groups = model.layout.obs_groups["critic"]
    assert len(groups) == 2
    together = torch.cat([model.normalizers[g](x[g]) for g in groups], 1)
    expected = Parity(join([dummy_symmetry().observations[g] for g in groups]))(together)
    torch.testing.assert_close(model.read("critic", model.normalize(x)), expected)


def test_weights_start_as_those_of_a_plain_network():
    torch.manual_seed(0)
    wide = Reflection(torch.arange(400), torch.ones(400))
    symmetric, plain = SymmetricHead(wide, SWAP, (256, 128), 0.01), Head(400, 3, (256, 128), 0.01)
    for own, other in ((symmetric.weights[0], plain.mlp[0].weight), (symmetric.weights[1], plain.mlp[2].weight)):
        assert float(own.detach().std()) == pytest.approx(float(other.detach().std()), rel=0.05)
    torch.testing.assert_close(symmetric.output_weight @ symmetric.output_weight.T, 1e-4 * torch.eye(3))


def test_a_head_that_shall_answers_zero_and_learns_from_there():
    head = SymmetricHead(SWAP, SWAP, (8, 4), 1.0)
    torch.nn.init.normal_(head.output_bias)
    head.answer_zero()
    assert not head(torch.randn(5, 3)).any()
    head(torch.randn(5, 3)).sum().backward()
    assert head.output_weight.grad.abs().max() > 0.0


def test_an_odd_width_is_refused():
    with pytest.raises(ValueError, match=r"hidden\[1\] must be even for a symmetric network, got 7"):
        SymmetricHead(SWAP, SWAP, (8, 7), 1.0)


def test_policies_and_values_are_symmetric_after_normalising_and_learning():
    torch.manual_seed(0)
    learner = DualPPO(symmetric_layout(), 8, DualPPOConfig(**(TINY | {"normalizer_stride": 1, "learning_rate": 1e-2})))
    for t in range(learner.cfg.steps):
        learner.act(observations(8, t))
        learner.process_step(torch.randn(8, 2), torch.zeros(8, dtype=torch.bool), torch.zeros(8, dtype=torch.bool))
    learner.compute_returns(observations(8, 100))
    before = learner.model(observations(5, 101)).detach()
    learner.update()
    model, x = learner.model.eval(), observations(5, 101)
    action = model(x)
    assert not torch.allclose(action, before)
    torch.testing.assert_close(model(mirrored(x)), dummy_symmetry().actions(action), atol=1e-5, rtol=1e-4)
    critic = model.critics["lower"]
    value, image = (critic(model.read("critic", model.normalize(o))) for o in (x, mirrored(x)))
    torch.testing.assert_close(value, image, atol=1e-5, rtol=1e-4)


def test_normalisers_see_both_sides():
    model = DualActorCritic(symmetric_layout(), (4,), 1.0)
    model.update_normalizers(observations(50, 3))
    x = observations(5, 7)
    for group, reflection in dummy_symmetry().observations.items():
        normalizer = model.normalizers[group]
        torch.testing.assert_close(normalizer(reflection(x[group])), reflection(normalizer(x[group])))


def test_layouts_keep_their_symmetry_as_plain_data():
    layout = symmetric_layout()
    plain: dict[str, Any] = json.loads(json.dumps(layout.to_plain()))
    again = AgentLayout.from_plain(plain)
    assert again.action_slices == layout.action_slices
    assert again.symmetry
    x = observations(3, 1)
    for group, value in x.items():
        assert torch.equal(again.symmetry.observations[group](value), mirrored(x)[group])
    assert AgentLayout.from_plain(plain | {"symmetry": None}).symmetry is None


def test_parts_and_joins_of_reflections():
    both = join([SWAP, Reflection(torch.tensor([0]), torch.tensor([-1.0]))])
    assert both(torch.tensor([1.0, 2.0, 3.0, 4.0])).tolist() == [2.0, 1.0, -3.0, -4.0]
    assert both.part(slice(2, 4))(torch.tensor([3.0, 4.0])).tolist() == [-3.0, -4.0]


@pytest.mark.parametrize("columns", [[[1, 2, 0], [1, 1, 1]], [[0, 3], [1, 1]], [[1, 0], [1, -1]], [[0, 0], [1, 1]]])
def test_columns_that_are_no_mirror_images_are_refused(columns: list[list[int]]):
    with pytest.raises(ValueError, match="mirror images of each other are not"):
        Symmetry.from_plain({"observations": {}, "actions": columns})


def test_a_checkpoint_with_a_broken_symmetry_is_refused(tmp_path: Path):
    content = load_checkpoint(save_random_policy(tmp_path / "policy.pt"))
    content["agents"]["symmetry"]["actions"] = [[5, 0], [1, 1]]
    path = tmp_path / "broken.pt"
    save_checkpoint(path, content)
    with pytest.raises(CheckpointError, match=r"broken\.pt.*mirror images"):
        load_policy(path)
