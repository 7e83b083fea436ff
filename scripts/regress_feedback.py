"""Search for linear terms on top of a policy as it is, many at once: every world gets small random values of them, and
what becomes of the robots is regressed on values and squares.

Trials are blows on the hand (`--trials impact`) or random commands (`--trials commands`). Prints, per term, what one
standard deviation of it does, linear and squared, in points of robots that fall and, with commands, in tracking errors.
Values of terms that are found are set where a policy is shipped (`ship_checkpoint.py --change`, `--scale`).
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from cotap.agents.checkpoint import write_json
from cotap.envs import H1Env
from cotap.envs.actions import JointTargets
from cotap.envs.commands import Command
from cotap.envs.gait import StepMotion, swing_progress
from cotap.evaluation.disturbance import Impact
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.metrics import tracking_measures
from cotap.evaluation.policy import Policy, find_checkpoint, load_policy
from cotap.evaluation.protocols import VelocityTracking
from cotap.evaluation.rollout import record_rollout

MEASURES = ("e_lin_gait", "e_yaw", "e_height", "foot_slip")
"""What is regressed beside falls where robots follow commands."""
DAMPING_S, GAIN, OFFSET_RAD, APART_M, HOLD_BACK_M, CATCH_LIFT, WAIST_S = 0.007, 0.05, 0.02, 0.02, 0.1, 0.25, 0.015
"""One standard deviation of a term: about what changes falls by a few percent of themselves."""
PER_TILT_RAD, PER_RATE_S = 0.06, 0.02
FEEDBACKS = {
    (1.0, 0.0, 0.0): (("gy", PER_TILT_RAD), ("wx", PER_RATE_S)),
    (0.0, 1.0, 0.0): (("gx", PER_TILT_RAD), ("wy", PER_RATE_S)),
    (0.0, 0.0, 1.0): (("wz", PER_RATE_S),),
}
"""What joints about an axis are told: projected gravity g, angular velocity w, and how far they follow it."""


@dataclass(frozen=True)
class Term:
    """One number that is searched for. `kind` says what it does, to legs' joint `joint` of `StepMotion.joints`."""

    name: str
    deviation: float
    kind: str
    joint: int = -1
    sense: str = ""


def terms_of(env: H1Env) -> list[Term]:
    """All terms, of the legs of a robot's first two feet while it steps, and of its waist."""
    spec, steps = env.spec, env.joint_targets.steps
    joints = [spec.joints[i] for i in steps.joints[0].tolist()]
    side = f"{spec.feet[0].side}_"
    names = [j.name.removeprefix(side) for j in joints]
    out = [Term(f"damping {name}", DAMPING_S, "damping", i) for i, name in enumerate(names)]
    out += [Term(f"gain {name}", GAIN, "gain", i) for i, name in enumerate(names)]
    out += [
        Term(f"offset {name}", OFFSET_RAD, "offset", i)
        for i, name in enumerate(names)
        if joints[i].axis == (0.0, 1.0, 0.0)
    ]
    out += [
        Term("feet apart", APART_M, "apart"), Term("held back", HOLD_BACK_M, "hold_back"),
        Term("lift under a lean", CATCH_LIFT, "catch_lift"), Term("waist wz", WAIST_S, "waist"),
    ]  # fmt: skip
    first = {joint.axis: i for i, joint in reversed(list(enumerate(joints)))}
    last = {joint.axis: i for i, joint in enumerate(joints)}
    for leg in ("standing", "swinging"):
        for i in sorted(set(first.values()) | set(last.values())):
            out += [
                Term(f"{leg} {names[i]} {sense}", deviation, leg, i, sense)
                for sense, deviation in FEEDBACKS[joints[i].axis]
            ]
    return out


class Perturbed:
    """A robot's `JointTargets` with terms on top, each world with values of its own.

    Args:
        env: Whose they are.
        terms: The K terms.
        values: (N, K) in standard deviations.
    """

    def __init__(self, env: H1Env, terms: list[Term], values: torch.Tensor) -> None:
        self._own: JointTargets = env.joint_targets
        n, joints = len(values), self._own.steps.joints.shape[1]
        self._per_joint = {kind: torch.zeros(n, 1, joints) for kind in ("damping", "gain", "offset")}
        self._feedback: list[tuple[Term, torch.Tensor]] = []
        self._shared: dict[str, torch.Tensor] = {}
        for term, value in zip(terms, values.unbind(1), strict=True):
            if term.kind in self._per_joint:
                self._per_joint[term.kind][:, 0, term.joint] = term.deviation * value
            elif term.sense:
                self._feedback.append((term, term.deviation * value))
            else:
                self._shared[term.kind] = value
        cfg, period = env.cfg.actions, env.cfg.commands.gait_period_s

        def step_motion(lift: float = 0.0, apart_m: float = 0.0) -> StepMotion:
            """Steps with one deviation of every term that is theirs."""
            return StepMotion(
                env.spec, env.sim.model, period, lift, 0.0, apart_m, hold_back_m=HOLD_BACK_M, catch_lift=CATCH_LIFT
            )

        self._steps = step_motion(lift=cfg.step_lift)
        still = torch.zeros(1)
        self._apart = step_motion(apart_m=APART_M)(still, torch.zeros(1, 2), still)

    def __getattr__(self, name: str) -> object:
        return getattr(self._own, name)

    def __call__(
        self, action: torch.Tensor, command: Command, joint_pos: torch.Tensor, joint_vel: torch.Tensor,
        projected_gravity: torch.Tensor, angular_velocity: torch.Tensor, arm_position: torch.Tensor,
    ) -> torch.Tensor:  # fmt: skip
        """Joint targets (N, J) [rad]; arguments are those of `JointTargets`."""
        target = self._own(action, command, joint_pos, joint_vel, projected_gravity, angular_velocity, arm_position)
        joints, g, w = self._own.steps.joints, projected_gravity, angular_velocity
        spin = w[:, 2] - command.yaw_rate
        senses = {"gx": g[:, 0], "gy": g[:, 1], "wx": w[:, 0], "wy": w[:, 1], "wz": spin}
        swings = (swing_progress(command.phase, len(joints)) > 0.0).float()
        own, shared = self._per_joint, {kind: value[:, None, None] for kind, value in self._shared.items()}
        legs = own["offset"] - own["damping"] * joint_vel[:, joints]
        legs = legs + own["gain"] * self._own.scale[joints] * action[:, joints]
        legs = legs + shared["apart"] * self._apart
        legs = legs + shared["hold_back"] * self._steps.holding_back(command.phase, g)
        legs = legs + shared["catch_lift"] * self._steps.catching(command.phase, g)
        for term, value in self._feedback:
            share = swings if term.kind == "swinging" else 1.0 - swings
            legs[..., term.joint] += share * (value * senses[term.sense]).unsqueeze(1)
        target[:, self._own.waist] += (WAIST_S * self._shared["waist"] * spin).unsqueeze(1)
        target[:, joints] += (1.0 - command.stand)[:, None, None] * legs
        return target


@dataclass(frozen=True)
class Fit:
    """What one standard deviation of each of K terms does to an outcome, and standard errors."""

    at_zero: float
    linear: np.ndarray
    squared: np.ndarray
    linear_error: np.ndarray
    squared_error: np.ndarray


def regress(values: np.ndarray, outcome: np.ndarray) -> Fit:
    """Least squares of an outcome (N,) on values (N, K) and their squares, over worlds that have an outcome (not NaN).

    Raises:
        ValueError: fewer worlds than there are coefficients to tell.
    """
    seen = np.isfinite(outcome)
    z, y = values[seen].astype(np.float64), outcome[seen].astype(np.float64)
    k = z.shape[1]
    if len(y) <= 2 * k + 1:
        raise ValueError(f"{2 * k + 1} coefficients take more worlds than {len(y)}; --worlds and --runs say how many")
    x = np.concatenate((np.ones((len(y), 1)), z, z**2), 1)
    inverse = np.linalg.pinv(x.T @ x)
    b = inverse @ x.T @ y
    error = np.sqrt(np.diag(inverse) * ((y - x @ b) ** 2).sum() / (len(y) - len(b)))
    return Fit(float(b[0]), b[1 : k + 1], b[k + 1 :], error[1 : k + 1], error[k + 1 :])


def run(policy: Policy, options: argparse.Namespace, seed: int) -> tuple[list[Term], np.ndarray, dict[str, np.ndarray]]:
    """One batch of worlds: the terms, values (N, K), and outcomes (N,) by name."""
    n, motion = options.worlds, (options.motion,) if options.motion else ()
    if options.trials == "impact":
        trials = Impact(num_envs=n, seed=seed, motion=motion, mode=options.mode, random_direction=True)
    else:
        trials = VelocityTracking(
            num_envs=n, seed=seed, motion=motion, episode_seconds=options.seconds, hand_force=options.hand_force
        )
    torch.manual_seed(seed)
    cfg = trials.configure(policy.env_config)
    cfg.upper_body = LawOptions(options.method, (options.stiffness,), alpha=options.alpha).configure()
    cfg.backend, cfg.num_threads = "mjbatch", options.threads
    env = H1Env(cfg)
    terms = terms_of(env)
    values = torch.randn(options.worlds, len(terms), generator=torch.Generator().manual_seed(seed))
    env.joint_targets = Perturbed(env, terms, values)  # pyright: ignore[reportAttributeAccessIssue]
    if isinstance(trials, Impact):
        trials.prepare(env)
        t = record_rollout(env, policy, round(trials.seconds / env.dt), before_step=trials.before_step)
        outcomes = {}
    else:
        t = record_rollout(env, policy, round(trials.episode_seconds / env.dt))
        measured = tracking_measures(t, cfg.commands.gait_period_s, trials.settle_seconds)
        outcomes = {name: measured[name].numpy() for name in MEASURES}
    return terms, values.numpy(), {"falls": t.fell.any(0).float().numpy()} | outcomes


def table(terms: list[Term], fits: dict[str, Fit]) -> str:
    """Terms in rows, those that change falls most first; linear and squared effects with standard errors."""
    falls = fits["falls"]
    lines = [", ".join(f"{name} {fit.at_zero:.4f}" for name, fit in fits.items()) + " where all terms are zero"]
    lines += ["", "| term | one standard deviation |" + "".join(f" {name} | and squared |" for name in fits)]
    lines.append("|---" * (2 + 2 * len(fits)) + "|")
    for k in np.argsort(-np.abs(falls.linear / falls.linear_error)):
        cells = "".join(
            f" {f.linear[k]:+.4f} +- {f.linear_error[k]:.4f} | {f.squared[k]:+.4f} +- {f.squared_error[k]:.4f} |"
            for f in fits.values()
        )
        lines.append(f"| {terms[k].name} | {terms[k].deviation:g} |{cells}")
    return "\n".join(lines)


def main(args: list[str] | None = None) -> int:
    """Run batches of worlds and print the regression over all of them after each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--policy", default="cotap", help="a checkpoint or the name of a shipped one")
    parser.add_argument("--trials", choices=("impact", "commands"), default="impact")
    parser.add_argument("--mode", choices=("stance", "walking"), default="walking", help="of the blows")
    parser.add_argument(
        "--motion", default="", help="a clip that the arms follow; under blows also mixture, and rest without"
    )
    parser.add_argument("--method", choices=("pd", "cotap"), default="cotap", help="law of the arms")
    parser.add_argument("--stiffness", type=float, default=300.0, help="[N/m]")
    parser.add_argument("--alpha", type=float, default=1.0)
    parser.add_argument("--worlds", type=int, default=1024, help="per batch")
    parser.add_argument("--runs", type=int, default=8, help="batches")
    parser.add_argument("--seconds", type=float, default=10.0, help="of commands")
    parser.add_argument("--hand-force", type=float, default=0.0, help="random, under commands, per axis [N]")
    parser.add_argument("--seed", type=int, default=1000, help="of the first batch")
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--output", type=Path, help="JSON with terms and fits")
    options = parser.parse_args(args)
    if options.threads:
        torch.set_num_threads(options.threads)
    all_values: list[np.ndarray] = []
    all_outcomes: dict[str, list[np.ndarray]] = {}
    policy = load_policy(find_checkpoint(options.policy))
    for i in range(options.runs):
        terms, values, outcomes = run(policy, options, options.seed + i)
        all_values.append(values)
        for name, outcome in outcomes.items():
            all_outcomes.setdefault(name, []).append(outcome)
        try:
            fits = {name: regress(np.concatenate(all_values), np.concatenate(o)) for name, o in all_outcomes.items()}
        except ValueError as error:
            print(f"after {i + 1} of {options.runs} batches: {error}", file=sys.stderr)
            if i + 1 == options.runs:
                return 2
            continue
        print(f"\n{(i + 1) * options.worlds} worlds: {table(terms, fits)}", flush=True)
        if options.output:
            found = {name: {"at_zero": f.at_zero} | _lists(f) for name, f in fits.items()}
            names = [{"term": t.name, "deviation": t.deviation} for t in terms]
            write_json(options.output, {"worlds": (i + 1) * options.worlds, "terms": names, "fits": found})
    return 0


def _lists(fit: Fit) -> dict[str, list[float]]:
    return {name: getattr(fit, name).tolist() for name in ("linear", "squared", "linear_error", "squared_error")}


if __name__ == "__main__":
    sys.exit(main())
