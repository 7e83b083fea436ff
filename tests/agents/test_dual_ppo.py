"""The learner: whose reward moves whose networks, by how much, and towards what."""

from __future__ import annotations

import copy
import math
from typing import Any

import pytest
import torch
from dummy_env import TARGETS, TINY, DummyEnv
from torch.distributions import Independent, Normal, kl_divergence

from cotap.agents import dual_ppo
from cotap.agents.actors import AgentLayout, Observations, as_dict
from cotap.agents.dual_ppo import DualPPO, DualPPOConfig
from cotap.agents.losses import LOWEST_RATE
from cotap.agents.precision import resolve_precision
from cotap.agents.runner import layout_of

AGENTS = ("lower", "upper")
SLICES = {"lower": slice(0, 3), "upper": slice(3, 5)}
CRITIC_GROUPS = ("policy", "privileged")


def make_learner(num_envs: int = 8, seed: int = 0, **ppo: Any) -> DualPPO:
    torch.manual_seed(seed)
    return DualPPO(layout_of(DummyEnv(num_envs)), num_envs, DualPPOConfig(**(TINY | ppo)))


def random_observations(num_envs: int, rng: torch.Generator) -> Observations:
    return {
        "policy": 5.0 + 3.0 * torch.randn(num_envs, 6, generator=rng),
        "privileged": 100.0 * torch.randn(num_envs, 2, generator=rng),
    }


def collect(learner: DualPPO, reward_seeds: tuple[int, int] = (1, 2), seed: int = 0) -> None:
    """Fill a rollout with random observations, rewards (each agent's from a seed of its own) and episode ends."""
    steps, envs = learner.rollout.rewards.shape[:2]
    rng = torch.Generator().manual_seed(seed)
    columns = [torch.randn(steps, envs, generator=torch.Generator().manual_seed(s)) for s in reward_seeds]
    rewards = torch.stack(columns, 2)
    torch.manual_seed(seed)
    for t in range(steps):
        learner.act(random_observations(envs, rng))
        dones = torch.rand(envs, generator=rng) < 0.3
        learner.process_step(rewards[t], dones, dones & (torch.rand(envs, generator=rng) < 0.5))
    learner.compute_returns(random_observations(envs, rng))


def parameters(learner: DualPPO, agent: str) -> dict[str, torch.Tensor]:
    """Everything of one agent that is learned, by name."""
    model = learner.model
    parts = {"actor": model.actors[agent], "critic": model.critics[agent]}
    named = {f"{part}.{k}": v for part, m in parts.items() for k, v in m.named_parameters()}
    return {k: v.detach().clone() for k, v in (named | {"log_std": model.log_std[agent]}).items()}


def gradients(learner: DualPPO, agent: str) -> list[torch.Tensor]:
    """What the last update left on one agent's parameters."""
    model = learner.model
    owned = [*model.actors[agent].parameters(), model.log_std[agent], *model.critics[agent].parameters()]
    return [p.grad.clone() for p in owned]


def policy(learner: DualPPO, agent: str, observations: torch.Tensor) -> Independent:
    """The agent's policy as torch has it, at normalised observations."""
    mean = learner.model.actors[agent](observations)
    return Independent(Normal(mean, learner.model.log_std[agent].exp().expand_as(mean)), 1)


def flat(learner: DualPPO, name: str) -> torch.Tensor:
    return getattr(learner.rollout, name).flatten(0, 1)


def seen(learner: DualPPO) -> dict[str, torch.Tensor]:
    """Inputs of actors and critics over the rollout."""
    stored = {g: v.flatten(0, 1) for g, v in learner.rollout.observations.items()}
    return {"actor": stored["policy"], "critic": torch.cat([stored[g] for g in CRITIC_GROUPS], 1)}


@pytest.mark.parametrize("changed", [0, 1])
def test_an_agent_learns_from_its_own_reward_and_from_no_other(changed: int):
    a, b = make_learner(), make_learner()
    seeds = [1, 2]
    collect(a, (seeds[0], seeds[1]))
    seeds[changed] = 3
    collect(b, (seeds[0], seeds[1]))
    before = {name: parameters(a, name) for name in AGENTS}
    torch.manual_seed(0)
    log_a = a.update()
    torch.manual_seed(0)
    log_b = b.update()
    own, other = AGENTS[changed], AGENTS[1 - changed]
    for key, value in parameters(a, other).items():
        assert torch.equal(value, parameters(b, other)[key]), f"{other} {key} depends on the reward of {own}"
        assert not torch.equal(value, before[other][key]), f"{other} {key} was not trained"
    differing = [k for k, v in parameters(a, own).items() if not torch.equal(v, parameters(b, own)[k])]
    assert differing == list(parameters(a, own))
    assert {k: v for k, v in log_a.items() if k.startswith(other)} == {
        k: v for k, v in log_b.items() if k.startswith(other)
    }


def test_every_parameter_belongs_to_exactly_one_optimiser():
    learner = make_learner()
    owned = [id(p) for opt in learner.optimizers.values() for group in opt.param_groups for p in group["params"]]
    assert len(owned) == len(set(owned))
    assert set(owned) == {id(p) for p in learner.model.parameters()}


def test_actions_are_scattered_about_the_mean_with_the_stated_spread():
    learner = make_learner(num_envs=4096, initial_std=0.3, steps=1, mini_batches=1)
    actions = learner.act(random_observations(4096, torch.Generator().manual_seed(0)))
    deviation = (actions - learner.rollout.means[0]) / 0.3
    # Standard errors are 1/64 for the mean and 1/90 for the standard deviation: 4.5 of them.
    torch.testing.assert_close(deviation.mean(0), torch.zeros(5), atol=0.07, rtol=0.0)
    torch.testing.assert_close(deviation.std(0), torch.ones(5), atol=0.05, rtol=0.0)
    assert torch.equal(actions, learner.rollout.actions[0])


def test_log_probabilities_are_each_agents_own_slice():
    learner = make_learner()
    with torch.no_grad():
        learner.model.log_std["upper"].copy_(torch.tensor([-1.0, 0.5]))
        learner.model.actors["lower"].mlp[-1].bias.fill_(2.0)
    collect(learner)
    actions, log_probs, inputs = flat(learner, "actions"), flat(learner, "log_probs"), seen(learner)["actor"]
    for g, name in enumerate(AGENTS):
        expected = policy(learner, name, inputs).log_prob(actions[:, SLICES[name]])
        torch.testing.assert_close(log_probs[:, g], expected.detach())


def test_a_time_out_pays_what_the_critic_expected_and_a_fall_does_not():
    learner = make_learner(num_envs=3, steps=1, gamma=0.9, upper_gamma=0.5, mini_batches=1)
    learner.act(random_observations(3, torch.Generator().manual_seed(0)))
    learner.rollout.values[0] = torch.tensor([[1.0, 10.0], [2.0, 20.0], [3.0, 30.0]])
    rewards = torch.tensor([[0.5, 0.25], [0.5, 0.25], [0.5, 0.25]])
    # World 0 goes on, env 1 falls, env 2 runs out of time.
    learner.process_step(rewards, torch.tensor([False, True, True]), torch.tensor([False, False, True]))
    torch.testing.assert_close(
        learner.rollout.rewards[0], torch.tensor([[0.5, 0.25], [0.5, 0.25], [0.5 + 0.9 * 3.0, 0.25 + 0.5 * 30.0]])
    )
    observations = random_observations(3, torch.Generator().manual_seed(1))
    learner.compute_returns(observations)
    normalized = learner.model.normalize(observations)
    critic_input = torch.cat([normalized[g] for g in CRITIC_GROUPS], 1)
    last = torch.cat([learner.model.critics[name](critic_input) for name in AGENTS], 1).detach()
    discounted = torch.tensor([0.9, 0.5]) * last[0]
    expected = torch.stack([rewards[0] + discounted, rewards[1], torch.tensor([3.2, 15.25])])
    torch.testing.assert_close(learner.rollout.returns[0], expected)


def test_advantages_are_whitened_for_each_agent_on_its_own():
    learner = make_learner()
    collect(learner)
    r = learner.rollout
    raw = (r.returns - r.values).flatten(0, 1)
    for g in range(2):
        own = raw[:, g]
        torch.testing.assert_close(r.advantages.flatten(0, 1)[:, g], (own - own.mean()) / own.std())
    assert not torch.allclose(raw.std(0)[0], raw.std(0)[1])


def test_first_step_against_losses_written_with_torch_distributions():
    """One pass over one batch: policies are still the old ones, so the gradient is the plain policy gradient."""
    settings = {"epochs": 1, "mini_batches": 1, "entropy": 0.05, "value": 0.7, "max_grad_norm": 0.02}
    learner = make_learner(**settings)
    collect(learner)
    oracle = copy.deepcopy(learner)
    log = learner.update()
    inputs, actions = seen(oracle), flat(oracle, "actions")
    for g, name in enumerate(AGENTS):
        actor, critic = oracle.model.actors[name], oracle.model.critics[name]
        advantage, target = flat(oracle, "advantages")[:, g], flat(oracle, "returns")[:, g]
        distribution = policy(oracle, name, inputs["actor"])
        gain = (advantage * distribution.log_prob(actions[:, SLICES[name]])).mean()
        entropy = distribution.entropy().mean()
        value_loss = (critic(inputs["critic"]).squeeze(1) - target).square().mean()
        own = {
            "policy": [*actor.parameters(), oracle.model.log_std[name]],
            "critic": list(critic.parameters()),
        }
        optimizer = torch.optim.Adam([*own["policy"], *own["critic"]], lr=oracle.cfg.learning_rate)
        (0.7 * value_loss - gain - 0.05 * entropy).backward()
        for part in own.values():
            norm = float(torch.cat([p.grad.flatten() for p in part]).norm())
            assert norm > 0.02, "nothing was clipped"
            for p in part:
                p.grad *= 0.02 / norm
        # Adam's first step hardly knows how large a gradient is, so gradients are compared as well.
        for mine, theirs in zip(gradients(learner, name), gradients(oracle, name), strict=True):
            torch.testing.assert_close(mine, theirs, atol=1e-7, rtol=1e-3)
        optimizer.step()
        for key, value in parameters(oracle, name).items():
            torch.testing.assert_close(parameters(learner, name)[key], value, atol=1e-6, rtol=1e-5, msg=f"{name} {key}")
        assert log[f"{name}/kl"] == pytest.approx(0.0, abs=1e-6)
        assert log[f"{name}/surrogate"] == pytest.approx(0.0, abs=1e-6)  # the mean of whitened advantages
        assert log[f"{name}/value"] == pytest.approx(float(value_loss.detach()), rel=1e-5)
        assert log[f"{name}/entropy"] == pytest.approx(float(entropy.detach()), rel=1e-5)
        assert log[f"{name}/learning_rate"] == oracle.cfg.learning_rate


def test_second_step_against_losses_written_with_torch_distributions():
    """A second pass sees a moved policy: its losses and KL are those between the first step's outcome and the old."""
    # So small a desired KL that the second step is surely taken at a lower rate.
    settings = {"mini_batches": 1, "learning_rate": 0.02, "clip": 0.1, "desired_kl": 1e-6}
    one, two = make_learner(epochs=1, **settings), make_learner(epochs=2, **settings)
    collect(one)
    collect(two)
    old = copy.deepcopy(one)
    first, log = one.update(), two.update()
    inputs, actions = seen(old), flat(old, "actions")
    for g, name in enumerate(AGENTS):
        new = policy(one, name, inputs["actor"])
        before = policy(old, name, inputs["actor"])
        taken, advantage = actions[:, SLICES[name]], flat(old, "advantages")[:, g]
        ratio = torch.exp(new.log_prob(taken) - before.log_prob(taken))
        assert float(((ratio - 1.0).abs() > 0.1).float().mean()) > 0.1, "nothing was clipped"
        surrogate = torch.where(
            advantage > 0.0, torch.clamp(ratio, max=1.1) * advantage, torch.clamp(ratio, min=0.9) * advantage
        )
        assert log[f"{name}/surrogate"] * 2 - first[f"{name}/surrogate"] == pytest.approx(
            -float(surrogate.mean().detach()), abs=1e-5
        )
        kl = float(kl_divergence(before, new).mean().detach())
        assert log[f"{name}/kl"] * 2 == pytest.approx(kl, rel=1e-4)
        assert log[f"{name}/learning_rate"] == pytest.approx(0.02 / 1.5)
        assert two.optimizers[name].param_groups[0]["lr"] == log[f"{name}/learning_rate"]


def test_steps_become_smaller_with_the_samples(monkeypatch: pytest.MonkeyPatch):
    """By hand: 50 samples an update, and the aim falls by half in 100."""
    asked: list[float] = []
    monkeypatch.setattr(dual_ppo, "adapt_learning_rate", lambda rate, _, aim: asked.append(aim) or rate)
    learner = make_learner(num_envs=10, steps=5, epochs=1, mini_batches=1, desired_kl=0.02, kl_half_life=100.0)
    for _ in range(3):
        collect(learner)
        learner.update()
    assert asked == pytest.approx([0.02, 0.02, 0.02 * 0.5**0.5, 0.02 * 0.5**0.5, 0.01, 0.01])  # of two agents


def test_every_sample_is_used_once_in_every_pass(monkeypatch: pytest.MonkeyPatch):
    learner = make_learner(epochs=3, mini_batches=4)
    collect(learner)
    batches: list[torch.Tensor] = []
    inner = learner._update_agent

    def spy(name: str, g: int, actor_in: Any, critic_in: Any, batch: Any, old: Any) -> Any:
        if name == "lower":
            batches.append(batch["log_probs"][:, 0])
        return inner(name, g, actor_in, critic_in, batch, old)

    monkeypatch.setattr(learner, "_update_agent", spy)
    learner.update()
    assert len(batches) == 12
    everything = flat(learner, "log_probs")[:, 0].sort().values
    for p in range(3):
        assert torch.equal(torch.cat(batches[4 * p : 4 * p + 4]).sort().values, everything)
    assert not torch.equal(torch.cat(batches[:4]), torch.cat(batches[4:8])), "passes are not shuffled"


def test_both_agents_reach_their_own_targets_in_a_few_updates():
    torch.manual_seed(0)
    env = DummyEnv(num_envs=128)
    cfg = DualPPOConfig(
        hidden=(16,), steps=8, epochs=5, mini_batches=4, precision="fp32", learning_rate=3e-3, entropy=0.0, gamma=0.5,
        upper_gamma=0.5,
    )  # fmt: skip
    learner = DualPPO(layout_of(env), env.num_envs, cfg)

    def error() -> torch.Tensor:
        mean = learner.model(as_dict(env.get_observations())).detach()
        return torch.stack([(mean - env.target)[:, part].abs().mean() for part in SLICES.values()])

    start = error()
    assert bool((start > 0.45).all())
    for _ in range(15):
        for _ in range(cfg.steps):
            obs, _, dones, extras = env.step(learner.act(as_dict(env.get_observations())))
            learner.process_step(extras["group_rewards"], dones, extras["time_outs"])
        learner.compute_returns(as_dict(obs))
        learner.update()
    end = error()
    assert bool((end < 0.1).all()), f"mean actions ended {end.tolist()} from {TARGETS}"
    assert bool((learner.rollout.values.mean((0, 1)) < 0.0).all())  # critics learned that rewards are negative


def test_bf16_runs_hidden_layers_only_and_changes_outputs_little():
    full, half = make_learner(precision="fp32"), make_learner(precision="bf16")
    rng = torch.Generator().manual_seed(0)
    observations = random_observations(8, rng)
    for learner in (full, half):
        with torch.no_grad():  # outputs of order one
            for name in AGENTS:
                learner.model.actors[name].mlp[-1].weight.mul_(100.0)
        torch.manual_seed(1)
        learner.act(observations)
    assert half.rollout.observations["policy"].dtype == torch.bfloat16
    assert full.rollout.observations["policy"].dtype == torch.float32
    for name in ("means", "values"):
        a, b = getattr(full.rollout, name)[0], getattr(half.rollout, name)[0]
        assert b.dtype == torch.float32
        assert float(a.abs().max()) > 0.1
        torch.testing.assert_close(a, b, atol=0.03, rtol=0.03)
        assert not torch.equal(a, b), f"{name} show no trace of bfloat16"
    # The output layer is exact: outputs that bfloat16 could not hold are not rounded to it.
    means = half.rollout.means[0]
    assert not torch.equal(means, means.bfloat16().float())
    # Noise on top is the same, so log probabilities, of the same deviations, agree.
    torch.testing.assert_close(full.rollout.log_probs[0], half.rollout.log_probs[0], atol=1e-3, rtol=1e-4)


def by_hand_entropy(learner: DualPPO, agent: str) -> float:
    return float((learner.model.log_std[agent].detach() + 0.5 * math.log(2.0 * math.pi * math.e)).sum())


@pytest.mark.parametrize(
    ("part", "value"),
    [("returns", math.nan), ("returns", math.inf), ("advantages", math.nan), ("advantages", math.inf),
     ("log_probs", math.nan)],
)  # fmt: skip
def test_a_step_is_skipped_where_the_gradient_of_either_network_is_not_finite(part: str, value: float):
    """The actor's by advantages, the critic's by returns. The other agent learns on, and knows nothing of it."""
    broken, sound = make_learner(), make_learner()
    for learner in (broken, sound):
        collect(learner)
    getattr(broken.rollout, part)[:, :, 0] = value
    before, moments = parameters(broken, "lower"), copy.deepcopy(broken.optimizers["lower"].state_dict())
    logs = []
    for learner in (broken, sound):
        torch.manual_seed(0)
        logs.append(learner.update())
    assert (logs[0]["lower/skipped"], logs[0]["upper/skipped"], logs[1]["lower/skipped"]) == (4.0, 0.0, 0.0)
    for key, kept in parameters(broken, "lower").items():
        assert torch.equal(kept, before[key]), key
    assert broken.optimizers["lower"].state_dict() == moments
    for key, learned in parameters(broken, "upper").items():
        assert torch.equal(learned, parameters(sound, "upper")[key]), key
    assert all(math.isfinite(v) for v in logs[0].values())


def test_the_log_is_the_mean_over_the_steps_that_were_not_skipped():
    """One sample of 48 breaks one mini-batch of two in each of two passes."""
    learner = make_learner(learning_rate=1e-7)
    collect(learner)
    entropy = by_hand_entropy(learner, "lower")
    learner.rollout.returns[3, 2, 0] = math.nan
    log = learner.update()
    assert log["lower/skipped"] == 2.0
    assert log["lower/entropy"] == pytest.approx(entropy, rel=1e-3)


def test_bf16_learns_finite_parameters():
    learner = make_learner(precision="bf16")
    collect(learner)
    log = learner.update()
    assert all(math.isfinite(v) for v in log.values())
    assert all(bool(p.isfinite().all()) and p.dtype == torch.float32 for p in learner.model.parameters())


def test_precision_is_chosen_from_what_the_processor_offers(monkeypatch: pytest.MonkeyPatch):
    for offers, expected in (({}, torch.float32), ({"avx512_bf16": True}, torch.bfloat16)):
        monkeypatch.setattr(torch.cpu, "get_capabilities", lambda offers=offers: offers)
        assert resolve_precision("auto", "cpu") == expected
        assert resolve_precision("fp32", "cpu") == torch.float32
        assert resolve_precision("bf16", "cpu") == torch.bfloat16


def test_normalisers_hold_mean_and_spread_of_what_they_saw():
    learner = make_learner(num_envs=16, steps=6, normalizer_stride=2)
    rng = torch.Generator().manual_seed(0)
    shown = [random_observations(16, rng) for _ in range(6)]
    for t, observations in enumerate(shown):
        learner.act(observations)
        used = {g: torch.cat([shown[i][g] for i in range(0, t + 1, 2)]) for g in CRITIC_GROUPS}
        for group, values in used.items():
            normalizer = learner.model.normalizers[group]
            torch.testing.assert_close(normalizer.mean, values.mean(0))
            torch.testing.assert_close(normalizer.std, values.std(0, unbiased=False))
            expected = (observations[group] - values.mean(0)) / (values.std(0, unbiased=False) + 0.01)
            torch.testing.assert_close(learner.rollout.observations[group][t], expected, atol=1e-4, rtol=1e-4)
        learner.process_step(torch.zeros(16, 2), torch.zeros(16, dtype=torch.bool), torch.zeros(16, dtype=torch.bool))


def test_deployed_policy_is_the_mean_and_needs_only_what_actors_read():
    learner = make_learner()
    collect(learner)
    learner.update()
    observations = random_observations(8, torch.Generator().manual_seed(5))
    deployed = learner.model({"policy": observations["policy"]})
    inputs = learner.model.normalize(observations)["policy"]
    for name in AGENTS:
        torch.testing.assert_close(deployed[:, SLICES[name]], policy(learner, name, inputs).mean)


def test_learner_goes_on_from_its_saved_state():
    a, b = make_learner(learning_rate=0.02), make_learner(seed=7, learning_rate=0.02)
    collect(a)
    a.update()
    assert a.learning_rates != b.learning_rates
    b.model.load_state_dict(a.model.state_dict())
    b.load_state_dict(copy.deepcopy(a.state_dict()))
    for learner in (a, b):
        collect(learner, seed=3)
        torch.manual_seed(4)
        learner.update()
    for name in AGENTS:
        for key, value in parameters(a, name).items():
            assert torch.equal(value, parameters(b, name)[key]), f"{name} {key}"
    assert a.learning_rates == b.learning_rates


def test_layout_learns_sizes_from_the_environment():
    layout = layout_of(DummyEnv(3))
    assert layout.num_actions == 5
    assert (layout.width("actor"), layout.width("critic")) == (6, 8)
    assert layout.to_plain() == {
        "observation_widths": {"policy": 6, "privileged": 2},
        "obs_groups": {"actor": ["policy"], "critic": ["policy", "privileged"]},
        "action_slices": {"lower": [0, 3], "upper": [3, 5]},
        "symmetry": None,
    }
    assert isinstance(layout, AgentLayout)


NAN = float("nan")
BAD = [
    ("steps", 0, "ppo.steps must be a positive integer, got 0"),
    ("steps", 2.5, "ppo.steps must be a positive integer, got 2.5"),
    ("epochs", -1, "ppo.epochs must be a positive integer, got -1"),
    ("mini_batches", 0, "ppo.mini_batches must be a positive integer, got 0"),
    ("normalizer_stride", 0, "ppo.normalizer_stride must be a positive integer, got 0"),
    ("hidden", (), r"ppo.hidden must name at least one layer, got \(\)"),
    ("hidden", (8, 0), r"ppo.hidden\[1\] must be a positive integer, got 0"),
    ("gamma", NAN, "ppo.gamma must be a finite number, got nan"),
    ("gamma", 1.01, r"ppo.gamma must lie in \[0.0, 1.0\], got 1.01"),
    ("upper_gamma", -0.1, r"ppo.upper_gamma must lie in \[0.0, 1.0\], got -0.1"),
    ("lam", -0.1, r"ppo.lam must lie in \[0.0, 1.0\], got -0.1"),
    ("lam", NAN, "ppo.lam must be a finite number, got nan"),
    ("clip", 0.0, "ppo.clip must lie in .*, got 0.0"),
    ("entropy", NAN, "ppo.entropy must be a finite number, got nan"),
    ("entropy", -0.01, "ppo.entropy must lie in .*, got -0.01"),
    ("value", math.inf, "ppo.value must be a finite number, got inf"),
    ("learning_rate", NAN, "ppo.learning_rate must be a finite number, got nan"),
    ("learning_rate", -1e-3, "ppo.learning_rate must lie in .*, got -0.001"),
    ("desired_kl", 0.0, "ppo.desired_kl must lie in .*, got 0.0"),
    ("kl_half_life", 0.0, "ppo.kl_half_life must lie in .*, got 0.0"),
    ("max_grad_norm", NAN, "ppo.max_grad_norm must be a finite number, got nan"),
    ("initial_std", 0.0, "ppo.initial_std must lie in .*, got 0.0"),
    ("precision", "fp16", "precision 'fp16' is unknown.*known: auto, bf16, fp32"),
    ("mini_batches", 49, "ppo.mini_batches must be at most num_envs \\* steps = 48, got 49"),
]


@pytest.mark.parametrize(("field", "value", "message"), BAD)
def test_bad_hyperparameters_are_named(field: str, value: Any, message: str):
    with pytest.raises(ValueError, match=message):
        make_learner(**{field: value})


def test_one_sample_has_no_spread_to_whiten_by_and_is_refused():
    with pytest.raises(ValueError, match=r"num_envs \* steps .* got 1|num_envs \* steps = 1"):
        make_learner(num_envs=1, steps=1, mini_batches=1)


def test_smallest_sizes_that_are_allowed_learn_finite_parameters():
    learner = make_learner(num_envs=2, steps=1, epochs=1, mini_batches=1, hidden=(1,))
    collect(learner)
    learner.update()
    assert all(bool(p.isfinite().all()) for p in learner.model.parameters())


def test_spread_narrows_on_schedule():
    config = {"num_envs": 10, "steps": 5, "initial_std": 0.8, "std_half_life": 100.0, "least_std": 0.3}
    learner, spreads = make_learner(**config), []
    for i in range(5):
        with torch.no_grad():
            for log_std in learner.model.log_std.values():
                log_std.fill_(1.0 if i % 2 else -3.0)  # whatever was learned
        collect(learner)
        learner.update()
        spreads.append(learner.model.log_std["lower"].detach().exp().tolist())
    expected = [0.8 * 0.5**0.5, 0.4, 0.3, 0.3, 0.3]
    assert spreads == [pytest.approx([std] * len(spreads[0])) for std in expected]
    again = make_learner(**config)
    again.load_state_dict(learner.state_dict())
    assert (again.iterations, again.samples) == (5, 250)


def test_spread_is_learned_where_no_schedule_is_set():
    learner = make_learner(num_envs=10, steps=5, initial_std=0.8, std_half_life=0.0, entropy=1.0, learning_rate=1e-2)
    before = learner.model.log_std["lower"].detach().clone()
    collect(learner)
    learner.update()
    assert bool((learner.model.log_std["lower"].detach() > before).all())  # the bonus widens it


def test_what_begins_wider_narrows_from_there():
    """One action at 1.6, one at 0.1, the rest at 0.2: by hand, 100 samples halve the bound; also after a restart."""
    config = {"num_envs": 10, "steps": 5, "initial_std": 0.2, "std_half_life": 100.0, "least_std": 0.06}
    learner = make_learner(**config)
    with torch.no_grad():
        learner.model.log_std["upper"][0], learner.model.log_std["upper"][1] = math.log(1.6), math.log(0.1)
    learner.begin_anew()
    for i in range(5):
        if i == 3:
            state = copy.deepcopy(learner.state_dict())
            learner = make_learner(**config)
            learner.load_state_dict(state)
        with torch.no_grad():
            for log_std in learner.model.log_std.values():
                log_std.fill_(1.0)
        collect(learner)
        learner.update()
        share = 0.5 ** (0.5 * (i + 1))
        std = learner.model.log_std["upper"].detach().exp()
        assert float(std[0]) == pytest.approx(1.6 * share)
        assert float(std[1]) == pytest.approx(max(0.2 * share, 0.06))
        assert float(learner.model.log_std["lower"].detach().exp().max()) == pytest.approx(max(0.2 * share, 0.06))


@pytest.mark.parametrize(
    ("begun", "message"), [([0.5], "begun_std.lower has 1 actions, expected 3"), ([NAN] * 3, "begun_std.lower .* nan")]
)
def test_exploration_of_other_actions_is_refused(begun: list[float], message: str):
    learner = make_learner()
    with pytest.raises(ValueError, match=message):
        learner.load_state_dict(learner.state_dict() | {"begun_std": {"lower": begun}})


def test_trained_networks_go_on_slowly():
    learner = make_learner(initial_std=0.5)
    before = {name: value.clone() for name, value in learner.model.state_dict().items()}
    learner.begin_anew()
    assert learner.learning_rates == {"lower": LOWEST_RATE, "upper": LOWEST_RATE}
    assert all(torch.equal(value, before[name]) for name, value in learner.model.state_dict().items())
