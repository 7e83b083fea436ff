"""Two agents, each a clipped-surrogate PPO on its own reward group (FALCON's scheme)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import nn

from cotap.agents.actors import AgentLayout, DualActorCritic, Observations
from cotap.agents.distillation import Guide
from cotap.agents.losses import (
    LOWEST_RATE,
    adapt_learning_rate,
    clipped_surrogate,
    clipped_value_loss,
    gaussian_entropy,
    gaussian_kl,
    gaussian_log_prob,
    generalized_advantages,
)
from cotap.agents.precision import PRECISIONS, resolve_precision
from cotap.agents.ranks import Ranks
from cotap.checks import quoted, require_one_of, require_positive_int, require_range, require_shape
from cotap.memory import require_memory


@dataclass
class DualPPOConfig:
    """Hyperparameters, the same for both agents but for the discount."""

    hidden: tuple[int, ...] = (256, 128, 64)
    """Hidden layers of every actor and critic."""
    initial_std: float = 0.6
    """Standard deviation of actions at the start."""
    std_half_life: float = 30e6
    """Samples in which the standard deviation of actions halves; 0 to learn it instead."""
    least_std: float = 0.2
    """Lower bound of the standard deviation while it follows `std_half_life`."""
    steps: int = 24
    """Steps per env and iteration."""
    epochs: int = 3
    """Passes over a rollout."""
    mini_batches: int = 4
    """Parts that each pass is cut into."""
    gamma: float = 0.99
    """Discount."""
    upper_gamma: float = 0.9
    """Discount of the agent `upper`: arms answer within a tenth of a second, and what happens later is noise to it."""
    lam: float = 0.95
    """Trace decay of the advantage estimates."""
    clip: float = 0.2
    """Clip range of the surrogate."""
    value_clip: float = 0.0
    """Clip range of the value loss: how far values may move from those of the rollout; 0 for no clipping."""
    entropy: float = 0.003
    """Weight of the entropy bonus."""
    value: float = 1.0
    """Weight of the value loss."""
    learning_rate: float = 1e-3
    """Learning rate at the start; it is then adapted to `desired_kl`, per agent."""
    desired_kl: float = 0.01
    """KL divergence of an update that the learning rate aims at, at the start [nat]."""
    kl_half_life: float = 150e6
    """Samples in which `desired_kl` halves: large updates first, later only what gradients agree on."""
    max_grad_norm: float = 1.0
    """Gradient norm above which gradients are scaled down, per network."""
    precision: str = "auto"
    """auto, bf16 or fp32."""
    normalizer_stride: int = 4
    """Observations of every so many steps update the normalisers."""
    symmetric: bool = True
    """Networks that are left-right symmetric by construction, where the environment tells what that is (see
    `cotap.agents.runner.layout_of`)."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        for name in ("steps", "epochs", "mini_batches", "normalizer_stride"):
            require_positive_int(f"ppo.{name}", getattr(self, name))
        require_one_of("ppo.precision", self.precision, PRECISIONS)
        if not self.hidden:
            raise ValueError("ppo.hidden must name at least one layer, got ()")
        for i, width in enumerate(self.hidden):
            require_positive_int(f"ppo.hidden[{i}]", width)
        for name in ("gamma", "upper_gamma", "lam"):
            require_range(f"ppo.{name}", getattr(self, name), 0.0, 1.0)
        for name in ("initial_std", "least_std", "clip", "learning_rate", "desired_kl", "max_grad_norm"):
            require_range(f"ppo.{name}", getattr(self, name), 1e-8, 1e6)
        require_range("ppo.std_half_life", self.std_half_life, 0.0, 1e15)
        require_range("ppo.kl_half_life", self.kl_half_life, 1.0, 1e15)
        for name in ("entropy", "value", "value_clip"):
            require_range(f"ppo.{name}", getattr(self, name), 0.0, 1e3)


@dataclass
class Rollout:
    """What one iteration collects: T steps, N envs, G agents, A actions.

    Observations (T, N, width of the group) are stored as the networks read them. `actions`, `means` and `guide_means`
    are (T, N, A), `dones` (T, N, 1), all others (T, N, G).
    """

    observations: Observations
    actions: torch.Tensor
    means: torch.Tensor
    guide_means: torch.Tensor | None
    log_probs: torch.Tensor
    values: torch.Tensor
    rewards: torch.Tensor
    dones: torch.Tensor
    advantages: torch.Tensor = field(init=False)
    returns: torch.Tensor = field(init=False)


class DualPPO:
    """Collects with the joint policy, learns with each agent's own reward.

    Args:
        layout: Sizes, slices and groups, from the environment.
        num_envs: Number of envs.
        cfg: Hyperparameters.
        device: Where the networks live.
        guide: A frozen policy that agents are kept close to at first; None for none.
        ranks: The processes that learn as one, each from its own `num_envs` envs.
    """

    def __init__(
        self, layout: AgentLayout, num_envs: int, cfg: DualPPOConfig, device: str = "cpu", guide: Guide | None = None,
        ranks: Ranks | None = None,
    ) -> None:  # fmt: skip
        cfg.check()
        self.cfg, self.device, self.layout = cfg, device, layout
        self.guide, self.ranks = guide, ranks or Ranks()
        self.dtype = resolve_precision(cfg.precision, device)
        self.names = tuple(layout.action_slices)
        self.model = DualActorCritic(layout, cfg.hidden, cfg.initial_std).to(device)
        for log_std in self.model.log_std.values():
            log_std.requires_grad_(cfg.std_half_life == 0.0)  # else it is on a schedule
        self._begun_std = {name: [0.0] * len(own) for name, own in self.model.log_std.items()}
        discounts = [cfg.upper_gamma if name == "upper" else cfg.gamma for name in self.names]
        self._discount = torch.tensor(discounts, device=device)
        self.learning_rates = dict.fromkeys(self.names, cfg.learning_rate)
        self.optimizers = {
            name: torch.optim.Adam(
                [
                    *self.model.actors[name].parameters(),
                    self.model.log_std[name],
                    *self.model.critics[name].parameters(),
                ],
                lr=cfg.learning_rate,
                fused=True,
            )
            for name in self.names
        }
        total = num_envs * cfg.steps
        if total < cfg.mini_batches:
            raise ValueError(f"ppo.mini_batches must be at most num_envs * steps = {total}, got {cfg.mini_batches}")
        if total < 2:  # advantages are scaled by their spread, which one sample does not have
            raise ValueError(f"num_envs * steps must be at least 2, got {total}")
        t, n, g, a = cfg.steps, num_envs, len(self.names), layout.num_actions
        seen = self.dtype.itemsize * sum(layout.observation_widths[k] for k in self.model.normalizers)
        own = 4 * ((3 if guide else 2) * a + 5 * g)
        shown = f"ppo.steps {quoted(t)} of {quoted(n)} envs"
        require_memory(shown, t * n * (seen + own), device)

        def buffer(width: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.zeros(t, n, width, dtype=dtype, device=device)

        self.rollout = Rollout(
            observations={k: buffer(layout.observation_widths[k], self.dtype) for k in self.model.normalizers},
            actions=buffer(a),
            means=buffer(a),
            guide_means=buffer(a) if guide else None,
            log_probs=buffer(g),
            values=buffer(g),
            rewards=buffer(g),
            dones=buffer(1, torch.bool),
        )
        self._kl = nn.Parameter(torch.zeros(1, device=device))
        self._step = 0
        self.iterations = self.samples = 0
        self._samples_per_iteration = t * n * self.ranks.size

    def _autocast(self) -> torch.autocast:
        return torch.autocast(torch.device(self.device).type, torch.bfloat16, enabled=self.dtype == torch.bfloat16)

    @torch.no_grad()
    def act(self, observations: Observations) -> torch.Tensor:
        """Sample actions (N, A) and remember what they were based on."""
        t, r, model = self._step, self.rollout, self.model
        if t % self.cfg.normalizer_stride == 0:
            model.update_normalizers(observations)
        for group, value in model.normalize(observations).items():
            r.observations[group][t] = value
        stored = {group: value[t] for group, value in r.observations.items()}
        with self._autocast():
            mean = model.mean_action(stored)
            critic_input = model.read("critic", stored)
            r.values[t] = torch.cat([model.critics[n](critic_input) for n in self.names], -1)
        std = torch.cat([model.log_std[n].exp() for n in self.names])
        actions = mean + std * torch.randn_like(mean)
        r.means[t], r.actions[t] = mean, actions
        if self.guide and self.guide.beta(self.samples) > 0.0 and r.guide_means is not None:
            r.guide_means[t] = self.guide.mean_action(observations)
        for g, name in enumerate(self.names):
            part = self.layout.action_slices[name]
            r.log_probs[t, :, g] = gaussian_log_prob(actions[:, part], mean[:, part], model.log_std[name])
        return actions

    @torch.no_grad()
    def process_step(self, group_rewards: torch.Tensor, dones: torch.Tensor, time_outs: torch.Tensor) -> None:
        """Record rewards (N, G), dones (N,) and time-outs (N,); the value stands in for what a time-out cut off."""
        t, r = self._step, self.rollout
        r.rewards[t] = group_rewards + self._discount * r.values[t] * time_outs.unsqueeze(1)
        r.dones[t] = dones.unsqueeze(1)
        self._step += 1

    @torch.no_grad()
    def compute_returns(self, observations: Observations) -> None:
        """Advantages and returns of the rollout, from the observations after its last step."""
        r, model = self.rollout, self.model
        with self._autocast():
            x = model.read("critic", {g: v.to(self.dtype) for g, v in model.normalize(observations).items()})
            last = torch.cat([model.critics[n](x) for n in self.names], -1)
        advantages = generalized_advantages(r.rewards, r.values, last, r.dones, self._discount, self.cfg.lam)
        r.returns = advantages + r.values
        r.advantages = self.ranks.standardize(advantages.flatten(0, 1)).unflatten(0, advantages.shape[:2])
        self._step = 0

    def update(self) -> dict[str, float]:
        """Learn from the rollout. Returns mean losses, KL and learning rate per agent, and how many steps were skipped
        because their gradient was not finite, for the log."""
        r, cfg = self.rollout, self.cfg
        flat = {
            key: getattr(r, key).flatten(0, 1)
            for key in ("actions", "means", "log_probs", "values", "returns", "advantages")
        }
        if r.guide_means is not None:
            flat["guide_means"] = r.guide_means.flatten(0, 1)
        observations = {g: v.flatten(0, 1) for g, v in r.observations.items()}
        old_log_std = {n: self.model.log_std[n].detach().clone() for n in self.names}
        total = flat["actions"].shape[0]
        sums: dict[str, torch.Tensor] = {}
        skipped = dict.fromkeys(self.names, 0)
        for _ in range(cfg.epochs):
            for ids in torch.randperm(total, device=self.device).chunk(cfg.mini_batches):
                batch = {key: value.index_select(0, ids) for key, value in flat.items()}
                inputs = {g: v.index_select(0, ids) for g, v in observations.items()}
                with self._autocast():
                    actor_in, critic_in = self.model.read("actor", inputs), self.model.read("critic", inputs)
                for g, name in enumerate(self.names):
                    stats = self._update_agent(name, g, actor_in, critic_in, batch, old_log_std[name])
                    if stats is None:
                        skipped[name] += 1
                        continue
                    for key, value in stats.items():
                        sums[f"{name}/{key}"] = sums.get(f"{name}/{key}", torch.zeros(())) + value
        self.iterations += 1
        self.samples += self._samples_per_iteration
        self._narrow_std()
        count = {name: max(1, cfg.epochs * cfg.mini_batches - skipped[name]) for name in self.names}
        log = {key: float(value) / count[key.partition("/")[0]] for key, value in sums.items()}
        for name in self.names:
            log[f"{name}/skipped"] = float(skipped[name])
            log[f"{name}/learning_rate"] = self.learning_rates[name]
            if self.guide and name in self.guide.cfg.agents:
                log[f"{name}/base_beta"] = self.guide.beta(self.samples - self._samples_per_iteration)
            spread = r.means[..., self.layout.action_slices[name]].flatten(0, 1).std(0)
            log[f"{name}/action_spread"] = float(spread.mean())  # over states; at zero the policy answers none
            log[f"{name}/action_std"] = float(self.model.log_std[name].detach().exp().mean())
        return log

    @torch.no_grad()
    def _narrow_std(self) -> None:
        cfg = self.cfg
        if cfg.std_half_life == 0.0:
            return
        share = 0.5 ** (self.samples / cfg.std_half_life)
        for name, log_std in self.model.log_std.items():
            now = [max(cfg.least_std, max(cfg.initial_std, begun) * share) for begun in self._begun_std[name]]
            log_std.copy_(torch.tensor(now, device=log_std.device).log())

    def _update_agent(
        self, name: str, g: int, actor_in: torch.Tensor, critic_in: torch.Tensor, batch: dict[str, torch.Tensor],
        old_log_std: torch.Tensor,
    ) -> dict[str, torch.Tensor] | None:  # fmt: skip
        """Statistics of the step, or None if its gradient is not finite and nothing was learned from it."""
        cfg, model = self.cfg, self.model
        part = self.layout.action_slices[name]
        with self._autocast():
            mean = model.actors[name](actor_in)
            value = model.critics[name](critic_in).squeeze(-1)
        log_std = model.log_std[name]
        with torch.no_grad():
            kl = gaussian_kl(batch["means"][:, part], old_log_std, mean, log_std).mean()
        log_prob = gaussian_log_prob(batch["actions"][:, part], mean, log_std)
        surrogate = clipped_surrogate(log_prob, batch["log_probs"][:, g], batch["advantages"][:, g], cfg.clip)
        value_loss = clipped_value_loss(value, batch["values"][:, g], batch["returns"][:, g], cfg.value_clip)
        entropy = gaussian_entropy(log_std)
        loss = surrogate + cfg.value * value_loss - cfg.entropy * entropy
        stats = {"surrogate": surrogate.detach(), "value": value_loss.detach(), "entropy": entropy.detach(), "kl": kl}
        beta = self.guide.beta(self.samples) if self.guide and name in self.guide.cfg.agents else 0.0
        if self.guide and beta > 0.0:
            distance = self.guide.kl(name, mean, log_std, batch["guide_means"][:, part])
            penalty = beta * distance
            loss = loss + penalty
            share = penalty / (penalty + surrogate.abs() + cfg.entropy * entropy.abs() + 1e-12)
            stats |= {"base_kl": distance.detach(), "base_share": share.detach()}
        optimizer = self.optimizers[name]
        optimizer.zero_grad()
        loss.backward()
        own = [*model.actors[name].parameters(), log_std, *model.critics[name].parameters()]
        self._kl.grad = kl.reshape(1)  # travels with the gradients: one message instead of two
        self.ranks.average_gradients([*own, self._kl])
        norm = nn.utils.clip_grad_norm_([*model.actors[name].parameters(), log_std], cfg.max_grad_norm)
        norm += nn.utils.clip_grad_norm_(model.critics[name].parameters(), cfg.max_grad_norm)
        if not torch.isfinite(norm):
            return None
        desired_kl = cfg.desired_kl * 0.5 ** (self.samples / cfg.kl_half_life)
        self.learning_rates[name] = adapt_learning_rate(self.learning_rates[name], float(self._kl.grad), desired_kl)
        for group in optimizer.param_groups:
            group["lr"] = self.learning_rates[name]
        optimizer.step()
        return stats

    def begin_anew(self) -> None:
        """Start with networks that are trained and optimisers that are not: from the lowest rate, since Adam's first
        steps are as large as its rate, whatever the gradient. Rates grow by themselves where a policy hardly moves.

        An action whose standard deviation is wider than `initial_std` by now narrows from there on."""
        self.learning_rates = dict.fromkeys(self.names, LOWEST_RATE)
        self._begun_std = {name: own.detach().exp().tolist() for name, own in self.model.log_std.items()}

    def state_dict(self) -> dict[str, Any]:
        """Optimisers, learning rates, numbers of iterations and samples, and what exploration began with; the networks
        are saved apart."""
        return {
            "optimizers": {name: opt.state_dict() for name, opt in self.optimizers.items()},
            "learning_rates": dict(self.learning_rates),
            "iterations": self.iterations,
            "samples": self.samples,
            "begun_std": self._begun_std,
            "guide": self.guide.state_dict() if self.guide else {},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` returned. Raises ValueError for moments of another size than the weights, or
        other actions."""
        for name, opt in self.optimizers.items():
            # How Adam steps is its own affair; what it has learned comes from the file.
            opt.load_state_dict(opt.state_dict() | {"state": state["optimizers"][name]["state"]})
            for parameter, moments in opt.state.items():
                for key in ("exp_avg", "exp_avg_sq"):
                    require_shape(f"optimizers.{name}.{key}", moments[key], tuple(parameter.shape))
        self.learning_rates = {
            name: require_range(f"learning_rates.{name}", state["learning_rates"][name], 0.0, 1.0)
            for name in self.names
        }
        self.iterations, self.samples = int(state["iterations"]), int(state["samples"])
        for name, begun in state["begun_std"].items():
            if len(begun) != len(self._begun_std[name]):
                raise ValueError(f"begun_std.{name} has {len(begun)} actions, expected {len(self._begun_std[name])}")
            self._begun_std[name] = [require_range(f"begun_std.{name}", std, 0.0, 1e6) for std in begun]
        if self.guide and state["guide"]:
            self.guide.load_state_dict(state["guide"])
