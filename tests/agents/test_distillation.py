"""The frozen base: what it costs to leave it, for how long, and that it stays what it was."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from dummy_env import TINY, DummyEnv
from test_dual_ppo import AGENTS, SLICES, collect, parameters
from torch.distributions import Independent, Normal, kl_divergence

from cotap.agents.actors import DualActorCritic
from cotap.agents.distillation import DistillationConfig, Guide
from cotap.agents.dual_ppo import DualPPO, DualPPOConfig
from cotap.agents.runner import layout_of

SAMPLES = 8 * TINY["steps"]
"""Of an iteration of 8 envs."""


def base_policy(seed: int = 5) -> DualActorCritic:
    torch.manual_seed(seed)
    model = DualActorCritic(layout_of(DummyEnv(8)), TINY["hidden"], 0.4)
    with torch.no_grad():
        for name in AGENTS:
            model.actors[name].mlp[-1].weight.normal_(0.0, 0.3)
    return model


def guided(base: DualActorCritic, cfg: DistillationConfig, **ppo: Any) -> DualPPO:
    torch.manual_seed(0)
    return DualPPO(layout_of(DummyEnv(8)), 8, DualPPOConfig(**(TINY | ppo)), guide=Guide(base, cfg))


def test_a_policy_begins_as_the_base_but_for_agents_that_begin_anew():
    base = base_policy()
    learner = guided(base, DistillationConfig(anew=("upper",), new_std=0.7))
    learner.guide.start(learner.model)
    torch.testing.assert_close(learner.model.log_std["upper"].exp(), torch.full((2,), 0.7))
    assert torch.equal(learner.model.log_std["lower"], base.log_std["lower"])
    x = {"policy": torch.randn(8, 6)}
    begun, wanted = learner.model(x), base(x)
    assert torch.equal(begun[:, SLICES["lower"]], wanted[:, SLICES["lower"]])
    assert wanted[:, SLICES["upper"]].abs().max() > 0.1
    assert not begun[:, SLICES["upper"]].any()
    hidden = learner.model.actors["upper"].mlp[0].weight
    assert torch.equal(hidden, base.actors["upper"].mlp[0].weight)


def test_an_agent_that_is_not_there_cannot_begin_anew():
    with pytest.raises(ValueError, match=r"distillation\.anew 'arms' is unknown"):
        DistillationConfig(anew=("arms",)).check()
    with pytest.raises(ValueError, match=r"distillation\.new_std must lie in .*, got 0"):
        DistillationConfig(new_std=0.0).check()


def test_weight_falls_linearly_to_zero():
    guide = Guide(base_policy(), DistillationConfig(beta=0.8, end_samples=10))
    assert [guide.beta(i) for i in (0, 5, 10, 99)] == pytest.approx([0.8, 0.4, 0.0, 0.0])


def test_penalty_is_the_kl_of_torch_distributions():
    """One pass over one batch: the logged KL is that between the present and the frozen policy."""
    base = base_policy()
    learner = guided(base, DistillationConfig(), epochs=1, mini_batches=1)
    collect(learner)
    before = copy.deepcopy(learner)
    log = learner.update()
    stored = {g: v.flatten(0, 1) for g, v in before.rollout.observations.items()}
    base_mean = before.rollout.guide_means.flatten(0, 1)
    new = Independent(Normal(before.model.actors["lower"](stored["policy"]), before.model.log_std["lower"].exp()), 1)
    old = Independent(Normal(base_mean[:, SLICES["lower"]], base.log_std["lower"].exp()), 1)
    assert log["lower/base_kl"] == pytest.approx(float(kl_divergence(new, old).mean().detach()), rel=1e-4)
    assert log["lower/base_beta"] == DistillationConfig().beta
    assert 0.0 < log["lower/base_share"] < 1.0
    assert "upper/base_kl" not in log


def test_exploration_on_a_schedule_adds_nothing_to_the_penalty():
    """By hand: half the squared distance of the means in deviations of the base, whatever the new policy's."""
    base = base_policy()
    learner = guided(base, DistillationConfig(), std_half_life=1e6, initial_std=0.9)
    mean, far = torch.zeros(4, 3), torch.full((4, 3), 0.2)
    log_std = learner.model.log_std["lower"]
    assert not log_std.requires_grad
    assert float(learner.guide.kl("lower", mean, log_std, mean)) == 0.0
    assert float(learner.guide.kl("lower", far, log_std, mean)) == pytest.approx(3 * 0.5 * (0.2 / 0.4) ** 2, rel=1e-5)


def test_the_base_sees_raw_observations_through_its_own_normalisers():
    base = base_policy()
    base.update_normalizers({"policy": torch.randn(50, 6) * 9.0, "privileged": torch.randn(50, 2)})
    learner = guided(base, DistillationConfig())
    observations = {"policy": 5.0 + torch.randn(8, 6), "privileged": torch.randn(8, 2)}
    learner.act(observations)
    torch.testing.assert_close(learner.rollout.guide_means[0], base(observations).detach())


def distance(learner: DualPPO, base: DualActorCritic) -> float:
    x = {"policy": 5.0 + 3.0 * torch.randn(500, 6), "privileged": torch.zeros(500, 2)}
    part = SLICES["lower"]
    return float((learner.model(x)[:, part] - base(x)[:, part]).square().mean())


def test_guidance_draws_the_guided_agent_to_the_base_and_leaves_the_other():
    base = base_policy()
    held = guided(base, DistillationConfig(beta=5.0, end_samples=1e6), learning_rate=0.01, desired_kl=10.0)
    free = guided(base, DistillationConfig(beta=0.0), learning_rate=0.01, desired_kl=10.0)
    for learner in (held, free):
        for i in range(40):
            collect(learner, seed=i)
            torch.manual_seed(i)
            learner.update()
    torch.manual_seed(0)
    assert distance(held, base) < 0.3 * distance(free, base)
    for key, value in parameters(held, "upper").items():
        assert torch.equal(value, parameters(free, "upper")[key]), key


def test_a_base_that_has_no_say_any_more_costs_nothing(monkeypatch: pytest.MonkeyPatch):
    learner = guided(base_policy(), DistillationConfig(end_samples=1))
    collect(learner)
    assert "lower/base_kl" in learner.update()
    monkeypatch.setattr(learner.guide, "mean_action", lambda _: pytest.fail("the base was asked"))
    collect(learner)
    log = learner.update()
    assert log["lower/base_beta"] == 0.0
    assert "lower/base_kl" not in log


def test_the_base_is_never_changed_and_a_change_is_noticed():
    base = base_policy()
    original = copy.deepcopy(base.state_dict())
    learner = guided(base, DistillationConfig(beta=1.0))
    for i in range(3):
        collect(learner, seed=i)
        learner.update()
    for key, value in learner.guide.model.state_dict().items():
        assert torch.equal(value, original[key]), key
    learner.guide.verify()
    weight = next(p for p in learner.guide.model.parameters() if p.dim() == 2)
    for changed in (-weight, weight.flip(0), weight + 1e-7):
        kept = weight.detach().clone()
        with torch.no_grad():
            weight.copy_(changed)
        with pytest.raises(RuntimeError, match="frozen base policy has changed"):
            learner.guide.verify()
        with torch.no_grad():
            weight.copy_(kept)
        learner.guide.verify()


def test_guidance_goes_on_where_it_stopped():
    base = base_policy()
    learner = guided(base, DistillationConfig(beta=1.0, end_samples=10 * SAMPLES))
    for i in range(3):
        collect(learner, seed=i)
        learner.update()
    other = guided(base_policy(seed=6), DistillationConfig(beta=1.0, end_samples=10 * SAMPLES))
    other.load_state_dict(copy.deepcopy(learner.state_dict()))
    assert other.guide.beta(other.samples) == pytest.approx(0.7)
    for key, value in base.state_dict().items():
        assert torch.equal(other.guide.model.state_dict()[key], value), key
    other.guide.verify()


@pytest.mark.parametrize(("field", "value"), [("beta", -1.0), ("end_samples", 0), ("agents", ("arms",))])
def test_bad_fields_are_named(field, value):
    with pytest.raises(ValueError, match=rf"distillation\.{field}"):
        Guide(base_policy(), DistillationConfig(**{field: value}))
