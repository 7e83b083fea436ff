"""Whether arms under a law can be made to go unstable, and how much energy can be drawn from them; pelvis fixed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from cotap.checks import require_positive_int, require_range
from cotap.compliance.interface import LawParameters
from cotap.compliance.laws import LAWS, WITHOUT_STIFFNESS, LawConfig
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.scripted_forces import ForceProfile
from cotap.evaluation.linearization import linearize
from cotap.evaluation.protocol import Protocol
from cotap.evaluation.report import heading, pyplot, save_figure
from cotap.evaluation.rollout import PolicyFunction, idle, picture_row
from cotap.persistence import uniform
from cotap.robots import RobotSpec
from cotap.robots.chains import arm_model

NOTHING_J = 1e-3
"""Energy up to which none counts as drawn [J]: the error of rounding and sampling."""
_CHUNK = 1000


@dataclass
class Stability(Protocol):
    """Linearised closed loop of an arm's law over random poses, and the energy that can be drawn from it."""

    num_envs: int = 256
    """Trials of energy. In half of them the stiffness changes."""
    randomize: bool = False
    """Vary masses, friction, gains and delay. In the trials of energy."""
    poses: int = 10_000
    """Arm poses to linearise at, within the joints' limits."""
    walls: tuple[float, ...] = (0.0, 100.0, 1000.0, 10000.0)
    """Springs that hold the hand, 0 for none [N/m]. The loop is linearised with each."""
    load_rad: float = 0.1
    """Standard deviation of joint errors, as under a load [rad]. Loops are linearised with them, too."""
    episode_seconds: float = 5.0
    """Length of a trial [s]."""
    settle_seconds: float = 6.0
    """Rest before a trial [s]."""
    force_size: float = 10.0
    """Amplitude of the swinging force on each hand [N]. Its direction is random."""
    frequency: tuple[float, float] = (0.2, 8.0)
    """Range of the force's frequency, log-uniform [Hz]."""
    change_factor: float = 4.0
    """Factor by which stiffness changes, about the commanded one. From 1 / sqrt(factor) to sqrt(factor) of it."""
    change_seconds: float = 0.5
    """Time between two changes of stiffness [s]."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        super().check()
        require_range("poses", require_positive_int("poses", self.poses), 1, 1_000_000)
        require_range("num_envs", self.num_envs, 2, 1_000_000)
        for i, wall in enumerate(self.walls):
            require_range(f"walls[{i}]", wall, 0.0, 1e7)
        require_range("load_rad", self.load_rad, 0.0, math.pi)
        require_range("episode_seconds", self.episode_seconds, 0.1, 3600.0)
        require_range("settle_seconds", self.settle_seconds, 0.1, 3600.0)
        require_range("force_size", self.force_size, 0.1, 1000.0)
        require_range("frequency[0]", self.frequency[0], 0.01, 25.0)
        require_range("frequency[1]", self.frequency[1], self.frequency[0], 25.0)
        require_range("change_factor", self.change_factor, 1.0, 1000.0)
        require_range("change_seconds", self.change_seconds, 0.02, 3600.0)

    def configure(self, env_cfg: HumanoidEnvConfig) -> HumanoidEnvConfig:
        """Turn the environment that a policy was trained in into this protocol's. Changes and returns `env_cfg`."""
        super().configure(env_cfg)
        env_cfg.fixed_base = True
        env_cfg.forces.scripted = ForceProfile((1.0, 1.0, 1.0), "both", start_s=0.0)
        return env_cfg

    def prepare(self, env: HumanoidEnv) -> None:
        """Raise ValueError unless both arms are under one law."""
        super().prepare(env)
        if env.cfg.upper_body.left != env.cfg.upper_body.right:
            raise ValueError("stability analyses one law: name it by --method, not by --left and --right")
        if env.cfg.upper_body.left.name in WITHOUT_STIFFNESS:
            for name in ("change_factor", "change_seconds"):
                self.require_default(name, "under a law without a stiffness")

    def evaluate(self, env: HumanoidEnv, policy: PolicyFunction) -> dict[str, Any]:  # noqa: ARG002
        """Analyse and measure the arms' law. Returns the measured part of the JSON."""
        arms = env.cfg.upper_body
        rates = growth_rates(env.spec, arms.built(arms.left), self, env.dt)
        exchanged, self.film = exchanged_energy(env, self)
        energy = energy_summary(exchanged)
        return {"num_poses": self.poses, "linearised": rates, "energy": energy}

    def table(self, result: dict[str, Any]) -> str:
        """Both parts as Markdown."""
        return table(result)

    def plot(self, path: Path, result: dict[str, Any]) -> None:
        """Growth and share of unstable poses per wall, and trials that energy is drawn from."""
        plot(path, result)


def random_poses(spec: RobotSpec, count: int, rng: torch.Generator) -> torch.Tensor:
    """Arm poses (count, A, n), uniform within 98 % of the joints' range [rad]."""
    arms = arm_model(spec)
    center, half = (arms.low + arms.high) / 2.0, 0.98 * (arms.high - arms.low) / 2.0
    return center + half * uniform(rng, -1.0, 1.0, count, *center.shape)


def growth_rates(spec: RobotSpec, law: LawConfig, protocol: Stability, dt: float) -> list[dict[str, float]]:
    """Largest real part of the linearised loop, whose law acts every `dt` [s], per wall, at rest and loaded: the
    largest, and how many are positive."""
    rng = torch.Generator().manual_seed(protocol.seed)
    arms = arm_model(spec)
    q = random_poses(spec, -(-protocol.poses // len(spec.arms)), rng)
    loads = (0.0, protocol.load_rad) if protocol.load_rad else (0.0,)
    rows = []
    for load in loads:
        target = (q + load * torch.randn(q.shape, generator=rng)).clamp(arms.low, arms.high)
        rates: list[list[torch.Tensor]] = [[] for _ in protocol.walls]
        for part in torch.arange(len(q)).split(_CHUNK):
            shape = (len(part), len(spec.arms))
            parameters = LawParameters(
                torch.tensor(law.stiffness).expand(*shape, 3), torch.full(shape, law.null_stiffness),
                torch.full(shape, law.alpha),
            )  # fmt: skip
            loop = linearize(lambda a: LAWS[law.name](a, law), arms, q[part], target[part], parameters, dt)
            for found, wall in zip(rates, protocol.walls, strict=True):
                found.append(loop.growth(wall))
        for found, wall in zip(rates, protocol.walls, strict=True):
            rate = torch.cat(found)[: protocol.poses]
            rows.append(
                {
                    "load_rad": load,
                    "wall": wall,
                    "largest_real_part": float(rate.max()),
                    "share_unstable": float((rate > 1e-6).double().mean()),
                }
            )
    return rows


def swings(protocol: Stability, num_hands: int, rng: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Amplitudes (N, H, 3) [N], heading frame, and angular frequencies (N, H, 1) [rad/s] of the forces on the hands."""
    n = protocol.num_envs
    direction = torch.randn(n, num_hands, 3, generator=rng)
    low, high = (math.log(bound) for bound in protocol.frequency)
    rate = 2.0 * math.pi * uniform(rng, low, high, n, num_hands, 1).exp()
    return protocol.force_size * direction / direction.norm(dim=-1, keepdim=True), rate


def exchanged_energy(env: HumanoidEnv, protocol: Stability) -> tuple[torch.Tensor, torch.Tensor]:
    """Energy (T, N) that forces on the hands have put into the robot since their onset, at rest [J], and the film of
    the first env, as `Trajectory` has it.

    Nothing is stored at rest, so that a negative one has been drawn from the law. Both hands count together, and what
    they do in the world, as the waist passes energy on from one to the other. In the second half of the envs the
    stiffness changes.
    """
    rng = torch.Generator().manual_seed(protocol.seed)
    env.motions.hold(random_poses(env.spec, env.num_envs, rng).flatten(1) * 0.5)
    amplitude, rate = (x.to(env.device) for x in swings(protocol, len(env.spec.arms), rng))
    env.reset()
    stiffness = env.upper_body.parameters.stiffness.clone()
    changing = torch.arange(env.num_envs, device=env.device) >= env.num_envs // 2
    hold = round(protocol.change_seconds / env.dt)
    energy = torch.zeros(env.num_envs, device=env.device)
    rows, frames = [], []
    act = idle(env)
    settle = round(protocol.settle_seconds / env.dt)
    for step in range(settle + round(protocol.episode_seconds / env.dt)):
        if step >= settle and (step - settle) % hold == 0:
            draw = uniform(rng, -0.5, 0.5, *stiffness.shape).to(env.device)
            changed = stiffness * protocol.change_factor**draw
            env.upper_body.parameters.stiffness = torch.where(changing[:, None, None], changed, stiffness)
        since = max(step - settle, 0) * env.dt
        env.forces.scripted.amplitude_h[:, :-1] = torch.sin(rate * since) * amplitude
        before = env.state.hand_pos_w
        _, _, _, extras = env.step(act({}))
        frames.append(picture_row(env))
        work = (env.hand_force_w * (env.state.hand_pos_w - before)).sum((1, 2))
        # Where an env has diverged it has been restarted: it has given all that can be.
        work = torch.where(extras["falls"], torch.full_like(work, -math.inf), work)
        energy = energy + torch.nan_to_num(work, nan=-math.inf, posinf=-math.inf)
        if step >= settle:
            rows.append(energy.clone())
    return torch.stack(rows).cpu(), torch.stack(frames).cpu()


def energy_summary(energy: torch.Tensor) -> dict[str, Any]:
    """Least energy (T, N) over time, per trial: mean, least, and the share of trials that lack more than nothing."""
    out = {}
    half = energy.shape[1] // 2
    for name, part in (("constant_stiffness", energy[:, :half]), ("changing_stiffness", energy[:, half:])):
        least = part.amin(0)
        finite = least[torch.isfinite(least)]
        out[name] = {
            "trials": least.numel(),
            "mean_least_energy": float(finite.mean()) if finite.numel() else None,
            "least_energy": float(finite.min()) if finite.numel() else None,
            "share_drawn": float((least < -NOTHING_J).double().mean()),
            "num_diverged": int((~torch.isfinite(least)).sum()),
        }
    return out


def table(content: dict[str, Any]) -> str:
    """Both parts as Markdown."""
    lines = [
        "| hand held by [N/m] | joint errors [rad] | largest real part [1/s] | poses unstable |",
        "|---|---|---|---|",
    ]
    for row in content["linearised"]:
        lines.append(
            f"| {row['wall']:g} | {row['load_rad']:g} | {row['largest_real_part']:+.2f} | {row['share_unstable']:.1%} |"
        )
    lines += ["", "| stiffness | least energy, mean [J] | least of all [J] | trials drawn from | diverged |"]
    lines.append("|---|---|---|---|---|")
    for name, row in content["energy"].items():
        numbers = [f"{row[k]:.4f}" if row[k] is not None else "-" for k in ("mean_least_energy", "least_energy")]
        lines.append(
            f"| {name.split('_')[0]} | {numbers[0]} | {numbers[1]} | {row['share_drawn']:.1%} | {row['num_diverged']} |"
        )
    return "\n".join([*lines, "", f"{heading(content)}: {content['num_poses']} poses"])


def plot(path: Path, content: dict[str, Any]) -> None:
    """Growth and share of unstable poses per wall, and trials that energy is drawn from."""
    plt = pyplot()

    figure, axes = plt.subplots(1, 3, figsize=(12.0, 3.4), constrained_layout=True)
    rows = content["linearised"]
    walls = sorted({row["wall"] for row in rows})
    for load, color in zip(sorted({row["load_rad"] for row in rows}), ("#2171b5", "#d95f02"), strict=False):
        mine = {row["wall"]: row for row in rows if row["load_rad"] == load}
        for axis, key in zip(axes, ("largest_real_part", "share_unstable"), strict=False):
            label = f"joint errors of {load:g} rad" if load else "at rest"
            axis.plot(range(len(walls)), [mine[w][key] for w in walls], "o-", color=color, label=label)
    for axis, label in zip(axes, ("largest real part [1/s]", "share of poses unstable"), strict=False):
        axis.set_xticks(range(len(walls)), ["free" if w == 0.0 else f"{w:g}" for w in walls])
        axis.set(xlabel="hand held by [N/m]", ylabel=label)
        axis.axhline(0.0, color="0.6", lw=0.8)
        axis.legend(frameon=False)
    axes[1].set_ylim(-0.02, 1.02)
    names = [name.split("_")[0] for name in content["energy"]]
    axes[2].bar(names, [row["share_drawn"] for row in content["energy"].values()], color="#2171b5", width=0.5)
    axes[2].set(xlabel="stiffness meanwhile", ylabel="share of trials that energy is drawn from", ylim=(0.0, 1.0))
    for axis in axes:
        axis.grid(alpha=0.2)
    figure.suptitle(f"stability, {content['method']}, {content['num_poses']} poses")
    save_figure(figure, path)
