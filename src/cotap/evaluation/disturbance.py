"""A hand is struck, or loaded and left so: what hand, arm and torso do about it (paper, section IV)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch

from cotap.checks import require_range
from cotap.compliance.laws import WITHOUT_STIFFNESS
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.scripted_forces import ForceProfile
from cotap.evaluation.metrics import masked_mean, outcome, summarize
from cotap.evaluation.report import pyplot, save_figure
from cotap.evaluation.rollout import Trajectory
from cotap.evaluation.scenario import Scenario
from cotap.evaluation.transient import back_within, transient_measures
from cotap.motions.reference import HELD, MIXTURE

BEFORE_S = 0.5
"""What a hand does in this time before the onset is what it is compared with afterwards [s]."""
PUSH_S = 0.1
"""The time from the onset in which an arm takes a push [s]."""
NEAR_LIMIT = 0.9
"""Share of its torque limit from which a joint counts as near it."""
RECOVERED_M = 0.01
"""A hand is back that errs by no more than this beyond what it did before."""
LEAST_WAY_M = 0.005
"""A load that moves the hand less than this has no overshoot beside its sway [m]."""


@dataclass
class Impact(Scenario):
    """A push on a hand or the base, 500 N for 50 ms: errors of hand, arm and torso, torques, recovery, falls."""

    motion: tuple[str, ...] = (MIXTURE,)
    """Clips for the arms, `mixture` or `none`. mixture: as in the training. none: hold --arm-pose."""
    force: tuple[float, float, float] = (500.0, 0.0, 0.0)
    """Force along x, y, z of the heading frame [N]."""
    hand: str = "left"
    """left, right or both."""
    place: str = "hand"
    """hand or base. A force on the base acts at its centre of mass."""
    duration: float = 0.05
    """How long the force lasts [s]."""
    random_direction: bool = False
    """Turn the force randomly about the vertical."""
    onset: float = 1.0
    """When the force begins [s]."""
    window: tuple[float, float] = (0.0, 1.0)
    """Measured time, from the onset [s]."""
    fall_seconds: float = 3.0
    """Falls count for this long from the onset [s]."""
    episode_seconds: float = 4.0
    """Length of the evaluation [s]."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        super().check()
        require_range("onset", self.onset, BEFORE_S, 3600.0)
        require_range("window[0]", self.window[0], 0.0, 3600.0)
        require_range("window[1]", self.window[1], self.window[0] + 0.02, 3600.0)
        require_range("fall_seconds", self.fall_seconds, 0.02, 3600.0)
        require_range("episode_seconds", self.episode_seconds, self.onset + max(self.window[1], self.fall_seconds), 1e4)
        self._profile().check()
        if self.place == "base":
            self.require_default("hand", "for a force on the base")
        if self.pelvis == "fixed":
            self.require_default("place", "while the pelvis is fixed")
        if not any(self.force[:2]):
            self.require_default("random_direction", "for a force along z alone")

    def _profile(self) -> ForceProfile:
        return ForceProfile(self.force, self.hand, self.onset, self.duration, 0.0, self.random_direction, self.place)

    @property
    def seconds(self) -> float:
        """Length of the evaluation [s]."""
        return self.episode_seconds

    def configure(self, env_cfg: HumanoidEnvConfig) -> HumanoidEnvConfig:
        """Turn the environment that a policy was trained in into this protocol's. Changes and returns `env_cfg`."""
        super().configure(env_cfg)
        env_cfg.forces.scripted = self._profile()
        return env_cfg

    def measured_steps(self, dt: float) -> range:
        """Control steps of the window."""
        onset, recorded = round(self.onset / dt), round(self.seconds / dt)
        return range(*(min(onset + round(bound / dt), recorded) for bound in self.window))

    def before_step(self, env: HumanoidEnv, step: int) -> None:
        """Follow the arms through the window."""
        self.watch.see(env, step, self.measured_steps(env.dt))

    def hit(self, env: HumanoidEnv) -> list[int]:
        """Indices of the hands whose error is `e_ee_hit`: those that the force is on, all for a force on the base."""
        return [i for i, a in enumerate(env.spec.arms) if self.place == "base" or self.hand in (a.side, "both")]

    def measure(self, trajectory: Trajectory, env: HumanoidEnv) -> dict[str, Any]:
        """The measured part of the evaluation's JSON, the number of falls aside."""
        t, hit = trajectory, self.hit(env)
        onset, measured = round(self.onset / t.dt), self.measured_steps(t.dt)
        begin, end = measured.start, measured.stop
        stood = ~t.fell.any(0)
        window = window_measures(t, begin, end, hit)
        if any(self.force):
            window |= response_measures(t, onset, begin, end, hit)
            window["j_upper_push"] = window_measures(t, onset, onset + round(PUSH_S / t.dt), hit)["j_upper"]
        release = onset + math.ceil(self.duration / t.dt - 1e-6)
        if any(self.force) and release < end:
            window |= transient_measures(t, onset, release, end, hit, BEFORE_S)
        elif any(self.force) and self.place == "hand":
            window["load_overshoot"] = load_overshoot(t, onset, begin, end, hit)
        if not self._without_load() and (commanded := self._commanded(env)):
            window["impedance_error"] = impedance_error(window, self.force, commanded)
        fall_end = onset + round(self.fall_seconds / t.dt)
        window["fall_fraction"] = t.fell[:fall_end].any(0)
        window |= self.watch.measures(t.alive()[begin:end], hit)
        return {
            "falls": falls_by_time(t, onset, fall_end),
            **outcome(window, stood, self.seed, self.per_env),
            "window": {"start": self.onset + self.window[0], "end": self.onset + self.window[1]},
            "curve": curve(t, onset, hit),
        } | self._stiffness(env, window, stood)

    def _without_load(self) -> str:
        """Why there is no held load of one direction on a hand; empty where there is."""
        if self.place != "hand" or not any(self.force):
            return "no hand is loaded"
        if self.duration < self.window[1]:
            return "the force is over before the window is"
        return "the force's direction differs between envs" if self.random_direction else ""

    def _commanded(self, env: HumanoidEnv) -> list[float] | None:
        """Stiffness [N/m] of the hands that the force is on; None under a law that commands none, where the policy sets
        it, and where both hands have one of their own."""
        modulation = env.cfg.upper_body.modulation
        if modulation.kind != "none" and not modulation.held:
            return None
        laws = [env.cfg.upper_body.of(env.spec.arms[hand].side) for hand in self.hit(env)]
        if any(law.name in WITHOUT_STIFFNESS or law.stiffness != laws[0].stiffness for law in laws):
            return None
        return list(laws[0].stiffness)

    def _stiffness(self, env: HumanoidEnv, measures: dict[str, torch.Tensor], stood: torch.Tensor) -> dict[str, Any]:
        """Force over displacement, where the load is held and is the same in all envs."""
        commanded = self._commanded(env)
        if reason := self._without_load():
            return {"effective_stiffness": {"commanded": commanded, "measured": None, "reason": reason}}
        measured: list[float | None] = []
        for force, axis in zip(self.force, "xyz", strict=True):
            moved = summarize(measures[f"displacement_{axis}"][stood], self.seed)
            low, high = moved["ci95"] or (0.0, 0.0)
            measured.append(force / float(moved["mean"] or 0.0) if force != 0.0 and low * high > 0.0 else None)
        out = {"commanded": commanded, "measured": measured}
        if None in measured:
            out["reason"] = "null: no force along that axis, or a displacement whose interval has zero in it"
        return {"effective_stiffness": out}

    def plot(self, path: Path, result: dict[str, Any]) -> None:
        """Hand error, torso velocity error and arm torque over time, means over the envs that stood."""
        plt = pyplot()

        curves = result["curve"]
        panels = (("hand_error", "hand error [m]"), ("torso_velocity_error", "torso velocity error [m/s]"),
                  ("arm_torque", "arm torque, 2-norm [Nm]"))  # fmt: skip
        figure, axes = plt.subplots(1, 3, figsize=(12, 3.4), constrained_layout=True)
        for axis, (name, label) in zip(axes, panels, strict=True):
            if curves["time"]:
                axis.plot(curves["time"], curves[name], color="#2171b5")
            axis.axvline(0.0, color="0.6", lw=0.8)
            axis.set(xlabel="time since the force set in [s]", ylabel=label)
            axis.grid(alpha=0.2)
        figure.suptitle(f"{result['protocol']}, {self.mode}, {result['method']}")
        save_figure(figure, path)


@dataclass
class ConstantLoad(Impact):
    """A load on a hand, held, 50 N downward: errors of hand, arm and torso, torques, effective stiffness, falls."""

    motion: tuple[str, ...] = (HELD,)
    """Clips for the arms, `mixture` or `none`. mixture: as in the training. none: hold --arm-pose."""
    force: tuple[float, float, float] = (0.0, 0.0, -50.0)
    """Force along x, y, z of the heading frame [N]."""
    duration: float = 1e5
    """How long the force lasts [s]."""
    window: tuple[float, float] = (2.0, 4.0)
    """Measured time, from the onset [s]."""
    fall_seconds: float = 4.0
    """Falls count for this long from the onset [s]."""
    episode_seconds: float = 5.0
    """Length of the evaluation [s]."""


def window_measures(t: Trajectory, begin: int, end: int, hit: list[int]) -> dict[str, torch.Tensor]:
    """Measures of the steps from `begin` to before `end` per env, (N,) each, up to a fall; NaN for an env with none.

    Hand errors are against the reference carried in the torso frame; `e_ee_hit` is that of the hands in `hit`. Torques
    are those at the ends of control steps, `peak_torque` the largest of any arm joint, `energy` the integral of
    |torque x rate| over all arm joints, `joints_near_limit` the share of all joints, the legs' too, near their limit.
    """
    part = replace(t, **{f.name: getattr(t, f.name)[begin:end] for f in fields(t) if f.name != "dt"})
    alive = t.alive()[begin:end]
    torque = part.arm_torque.norm(dim=2)
    power = (part.arm_torque * part.arm_velocity).abs().sum(2)
    arm_share = part.torque_share[..., -part.arm_torque.shape[2] :]
    error = (part.velocity - part.command)[..., :2]
    seen = alive.any(0)
    nothing = torch.full(seen.shape, math.nan)
    peak = torch.where(alive, part.arm_torque.abs().amax(2), torch.zeros_like(torque)).amax(0)
    energy = torch.where(alive, power, torch.zeros_like(power)).sum(0) * t.dt
    return {
        "e_torso": masked_mean(error.norm(dim=2), alive),
        **{f"e_torso_{axis}": masked_mean(error[..., i].abs(), alive) for i, axis in enumerate("xy")},
        "e_ee": masked_mean(part.hand_error.mean(2), alive),
        "e_ee_hit": masked_mean(part.hand_error[..., hit].mean(2), alive),
        "j_upper": masked_mean(torque, alive),
        "e_upper": masked_mean(part.arm_error.norm(dim=2), alive),
        "peak_torque": torch.where(seen, peak, nothing),
        "share_at_limit": masked_mean((arm_share > 0.999).any(2).float(), alive),
        "joints_near_limit": masked_mean((part.torque_share > NEAR_LIMIT).float().mean(2), alive),
        "energy": torch.where(seen, energy, nothing),
        "fall_fraction": t.fell[:end].any(0),
    }


def response_measures(t: Trajectory, onset: int, begin: int, end: int, hit: list[int]) -> dict[str, torch.Tensor]:
    """How far the hands in `hit` went and how soon they were back, per env, (N,) each.

    Displacements are means over the window of the hand's offset from its reference, less that of the half second
    before the onset; NaN for an env that fell before the window's end.
    """
    before = t.hand_offset[onset - round(BEFORE_S / t.dt) : onset][:, :, hit].mean((0, 2))
    moved = t.hand_offset[begin:end][:, :, hit].mean((0, 2)) - before
    upright = t.alive()[end - 1].unsqueeze(1)
    moved = torch.where(upright, moved, torch.full_like(moved, math.nan))
    seconds, recovered = recovery(t.hand_error[..., hit].mean(2), t.alive(), onset, t.dt)
    return {
        "recovery_s": seconds,
        "recovered_fraction": recovered,
        **{f"displacement_{axis}": moved[:, i] for i, axis in enumerate("xyz")},
    }


def impedance_error(
    displacement: dict[str, torch.Tensor], force: Sequence[float], stiffness: Sequence[float]
) -> torch.Tensor:
    """Distance (N,) [m] of the hand's displacement from the one that a spring of the commanded `stiffness` [N/m] gives
    under `force` [N], x, y, z of the heading frame."""
    expected = torch.tensor([f / k for f, k in zip(force, stiffness, strict=True)])
    moved = torch.stack([displacement[f"displacement_{axis}"] for axis in "xyz"], 1)
    return (moved - expected).norm(dim=1)


def load_overshoot(t: Trajectory, onset: int, begin: int, end: int, hit: list[int]) -> torch.Tensor:
    """How far beyond its rest a load first carries the hands in `hit`, over the way to that rest, (N,).

    Rest is the mean displacement from `begin` to before `end`; what counts is the displacement along it, up to where it
    first turns back beyond half the way: what comes later is sway. NaN for an env that fell before the window's end, or
    whose hand rests within `LEAST_WAY_M` of where it was.
    """
    offset = t.hand_offset[:, :, hit].mean(2)
    moved = offset[onset:end] - offset[onset - round(BEFORE_S / t.dt) : onset].mean(0)
    rest = moved[begin - onset :].mean(0)
    way = rest.norm(dim=1).clamp_min(1e-9)
    along = (moved * (rest / way.unsqueeze(1))).sum(2) / way
    turned = (along[:-1] > 0.5) & (along[1:] < along[:-1])
    first = torch.nn.functional.pad(turned.cumsum(0) == 0, (0, 0, 1, 0), value=True)  # up to the turn, and the turn
    beyond = (torch.where(first, along, 0.0).amax(0) - 1.0).clamp_min(0.0)
    measured = t.alive()[end - 1] & (way > LEAST_WAY_M)
    return torch.where(measured, beyond, torch.full_like(way, math.nan))


def recovery(error: torch.Tensor, alive: torch.Tensor, onset: int, dt: float) -> tuple[torch.Tensor, torch.Tensor]:
    """When `error` (T, N) is back for good within `RECOVERED_M` of its mean of the half second before the onset.

    Returns:
        Seconds (N,) from the onset, NaN where it never leaves, never comes back within the record, or the robot falls;
        and whether (N,) the robot stands and the error is back, or never left, by the record's end.
    """
    before = error[onset - round(BEFORE_S / dt) : onset].mean(0)
    return back_within(error, before + RECOVERED_M, alive, onset, dt)


def falls_by_time(t: Trajectory, onset: int, end: int) -> dict[str, int]:
    """How many envs fell first before the step `onset`, from there to before `end`, and later."""
    before, within, ever = (t.fell[:k].any(0) for k in (onset, end, len(t.fell)))
    counts = (before, within & ~before, ever & ~within)
    return dict(zip(("before_onset", "to_window_end", "later"), (int(c.sum()) for c in counts), strict=True))


def curve(t: Trajectory, onset: int, hit: list[int]) -> dict[str, list[float]]:
    """Mean over standing envs of what happens over time, from up to a second before the onset.

    Displacements are relative to the last step before it; `_std` is their standard deviation over envs.
    """
    begin = max(0, onset - round(1.0 / t.dt))
    stood = ~t.fell.any(0)
    if not stood.any():
        return {"time": []}
    offset = t.hand_offset[begin:, stood][:, :, hit].mean(2)
    moved = offset - offset[onset - 1 - begin]
    velocity = (t.velocity - t.command)[begin:, stood]
    rows = {
        "time": (torch.arange(begin, len(t.fell)) - onset + 1) * t.dt,
        "hand_error": t.hand_error[begin:, stood][..., hit].mean((1, 2)),
        **{f"hand_displacement_{axis}": moved[..., i].mean(1) for i, axis in enumerate("xyz")},
        **{f"hand_displacement_{axis}_std": moved[..., i].std(1, correction=0) for i, axis in enumerate("xyz")},
        "torso_velocity_error": velocity[..., :2].norm(dim=2).mean(1),
        **{f"velocity_error_{axis}": velocity[..., i].mean(1) for i, axis in enumerate("xy")},
        **{f"velocity_error_{axis}_abs": velocity[..., i].abs().mean(1) for i, axis in enumerate("xy")},
        "arm_torque": t.arm_torque[begin:, stood].norm(dim=2).mean(1),
    }
    return {name: values.tolist() for name, values in rows.items()}
