"""What offsets of the arms' targets add that undo what the arms' inertia costs, beside what a policy's agent adds.

python -m reports.arm_oracle --checkpoint h1-cotap --stiffness 300 --alpha 1 --num-envs 256

Options are those of `cotap evaluate velocity-tracking`. Three evaluations follow, alike in all but the arms' targets:
the raw reference; the policy's; and the raw reference plus `K^-1 M a`, where `K` is the joint stiffness that the law
commands, `M` the nominal inertia of the arm and `a` the reference's acceleration. It is no bound: other errors, as of
masses that differ or of a torso that moves, are left.
"""

from __future__ import annotations

import sys
from typing import Any

import torch

from cotap.checks import shortened
from cotap.compliance.dynamics import joint_inertia
from cotap.envs import HumanoidEnv
from cotap.evaluate import parse, prepare
from cotap.evaluation.rollout import PolicyFunction, reference_actions
from reports.paper.relative import relative_change

TARGETS = ("reference", "policy", "inertia")
_LARGEST = 0.5
"""Of an offset [rad]; acceleration jumps where one motion ends and another begins."""


class InertiaFedForward:
    """Actions of a policy's legs, and the arms' raw reference plus `K^-1 M a`.

    Args:
        env: Whose arms are moved, under a law that has a stiffness.
        policy: Whose legs walk.
    """

    def __init__(self, env: HumanoidEnv, policy: PolicyFunction) -> None:
        self._env, self._policy = env, policy
        self._velocity = env.motions.current().velocity

    def __call__(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """Actions (N, A)."""
        env, velocity = self._env, self._env.motions.current().velocity
        acceleration, self._velocity = (velocity - self._velocity) / env.dt, velocity.clone()
        actions = torch.cat((self._policy(observations)[:, : env.num_lower], reference_actions(env)), 1)
        upper = slice(env.num_lower, env.num_lower + velocity.shape[1])
        actions[:, upper] += self.offset(acceleration).clamp(-_LARGEST, _LARGEST) / env.joint_targets.scale[upper]
        return actions

    def offset(self, acceleration: torch.Tensor) -> torch.Tensor:
        """`K^-1 M a` (N, U) [rad] of accelerations (N, U) [rad/s^2]; none before a law has commanded a stiffness."""
        law, arms = self._env.upper_body, self._env.state.arms
        inertia = joint_inertia(law.arms.inertias, arms)
        torque = inertia @ acceleration.reshape(*inertia.shape[:-1], 1)
        stiffness = law.stiffness
        known = stiffness.diagonal(dim1=-2, dim2=-1).amin(-1) > 0.0
        eye = torch.eye(stiffness.shape[-1], dtype=stiffness.dtype, device=stiffness.device)
        offset = torch.linalg.solve(torch.where(known[..., None, None], stiffness, eye), torque).squeeze(-1)
        return (offset * known.unsqueeze(-1)).flatten(1)


def measure(targets: str, arguments: list[str]) -> dict[str, Any]:
    """The result of velocity tracking with those targets of the arms, one of `TARGETS`."""
    actions = ["--upper-actions", "reference"] if targets == "reference" else []
    options = parse(["velocity-tracking", "--per-env", *arguments, *actions])
    env, policy, _ = prepare(options)
    return options.protocol.evaluate(env, InertiaFedForward(env, policy) if targets == "inertia" else policy)


def table(results: dict[str, dict[str, Any]]) -> str:
    """Errors of the arms, and their change from the raw reference, robot by robot."""
    lines = ["| targets of the arms | e_upper [rad] | change from the raw reference | fell |", "|---|---|---|---|"]
    for name, result in results.items():
        change = relative_change(results["reference"]["per_env"], result["per_env"], "e_upper")
        low, high = change["ci95"] or (float("nan"), float("nan"))
        shown = "-" if name == "reference" else f"{change['mean']:+.1%} [{low:+.1%},{high:+.1%}]"
        lines.append(f"| {name} | {result['metrics']['e_upper']['mean']:.4f} | {shown} | {result['num_falls']} |")
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> int:
    """Measure and print. Returns the exit status, 2 for bad input."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        print(table({targets: measure(targets, arguments) for targets in TARGETS}))
    except (ValueError, OSError) as error:
        print(f"error: {shortened(str(error))}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
