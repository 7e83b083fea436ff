"""Upper-body laws by name: how arms answer to their targets and to forces, behind one interface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import torch

from cotap.checks import require_one_of, require_range
from cotap.compliance.admittance import AdmittanceLaw, StaticShift, VirtualMass
from cotap.compliance.arguments import full_precision
from cotap.compliance.dynamics import critical_damping, gravity_torque, joint_inertia
from cotap.compliance.fast import ArmStiffness, blended_stiffness
from cotap.compliance.impedance import BlendedTorqueLaw
from cotap.compliance.interface import Arms, ArmState, LawParameters, LawReport, TorqueLaw, UpperBodyLaw
from cotap.compliance.pose_task import blended_pose_stiffness, pose_jacobian
from cotap.compliance.small_matrices import inverse_3x3
from cotap.compliance.stiffness import project_compliance

ERRORS = ("joint", "task")
DAMPINGS = ("pd", "critical")
SENSING = ("privileged", "estimated")


@dataclass
class LawConfig:
    """One arm's law and its parameters as every env has them at first."""

    name: str = "pd"
    """pd, soft-pd, cotap, facet, cotap+facet, cotap+facet-matched, hmc or dcc."""
    stiffness: tuple[float, float, float] = (300.0, 300.0, 300.0)
    """Hand stiffness K_ee along x, y and z of the heading frame [N/m] (all but pd and soft-pd)."""
    null_stiffness: float = 40.0
    """Stiffness k_null of arm motion that leaves the hand where it is [Nm/rad] (cotap): of the joint with the largest
    PD gain; that of the others is as many times lower as their gains are."""
    alpha: float = 1.0
    """Share of compliance in its blend with PD: 1 all compliance, 0 all PD. Of stiffness and with gravity compensation
    under cotap, of torques under hmc."""
    condition_threshold: float = 10.0
    """Condition number of the hand's Jacobian above which compliance gives way to PD (cotap; paper, equation 10)."""
    error: str = "joint"
    """joint: stiffness acts on joint errors (the paper). task: on the hand's, exact at any displacement (cotap)."""
    damping: str = "critical"
    """critical: from stiffness and joint-space inertia, on the rate at which joints leave their reference. pd: the PD
    law's, on the rate of the joints (the paper; cotap)."""
    rotational_stiffness: float = 0.0
    """Stiffness of the hand's orientation about every axis [Nm/rad]. Above 0, the hand's task is its pose, for arms of
    six joints or more and with the joint error; at 0 the hand may turn as it likes (cotap)."""
    characteristic_length: float = 0.2
    """What a radian counts as where the hand's task is its pose and singular values are compared [m] (cotap)."""
    soft_gain: float = 30.0
    """Position gain [Nm/rad] (soft-pd)."""
    virtual_mass: float = 1.0
    """Mass of the hand's model [kg] (facet; hmc takes its damping from it)."""
    damping_ratio: float = 1.0
    """Damping of the hand's model, as a share of critical (facet, hmc)."""
    sensing: str = "privileged"
    """Force on the hand: privileged, from the simulation, or estimated, from arm torques (facet, dcc)."""
    reference_share: float = 0.5
    """Share of the compliance that the moving reference provides; the arm does the rest (cotap+facet-matched)."""

    passive: bool = False
    """Hold back changes of stiffness that would give away more energy than a store has (cotap)."""
    store_energy: float = 2.0
    """Capacity and initial level of the energy store of a `passive` law [J] (cotap)."""
    store_power: float = 10.0
    """Most that changes of stiffness may inject per time [W]."""

    def check(self, where: str = "law") -> None:
        """Raise ValueError naming the first field, under `where`, that is out of its range."""
        require_one_of(f"{where}.name", self.name, LAWS.keys())
        require_one_of(f"{where}.error", self.error, ERRORS)
        require_one_of(f"{where}.damping", self.damping, DAMPINGS)
        require_one_of(f"{where}.sensing", self.sensing, SENSING)
        for i, value in enumerate(self.stiffness):
            require_range(f"{where}.stiffness[{i}]", value, 1.0, 1e5)
        if max(self.stiffness) > 300.0 * min(self.stiffness):  # beyond, rounding shows in the blend
            raise ValueError(
                f"{where}.stiffness may be at most 300 times as much along one axis as along another, got "
                f"{self.stiffness}"
            )
        require_range(f"{where}.null_stiffness", self.null_stiffness, 0.1, 1e4)
        require_range(f"{where}.alpha", self.alpha, 0.0, 1.0)
        require_range(f"{where}.condition_threshold", self.condition_threshold, 1.0, 1e9)
        require_range(f"{where}.rotational_stiffness", self.rotational_stiffness, 0.0, 1e4)
        require_range(f"{where}.characteristic_length", self.characteristic_length, 1e-3, 1e3)
        if self.rotational_stiffness and self.error != "joint":
            raise ValueError(f"{where}.rotational_stiffness goes with error 'joint', got error {self.error!r}")
        require_range(f"{where}.soft_gain", self.soft_gain, 0.1, 1e4)
        require_range(f"{where}.virtual_mass", self.virtual_mass, 0.01, 1e3)
        require_range(f"{where}.damping_ratio", self.damping_ratio, 0.01, 100.0)
        require_range(f"{where}.reference_share", self.reference_share, 0.01, 0.99)
        require_range(f"{where}.store_energy", self.store_energy, 0.0, 1e6)
        require_range(f"{where}.store_power", self.store_power, 0.0, 1e6)
        if self.passive and not reads(self.name, "passive"):
            raise ValueError(f"{where}.passive: {self.name} has no energy store; laws that can have one: cotap")

    def kind(self) -> tuple[object, ...]:
        """All that is not a parameter of envs: arms that agree in it are driven by one law."""
        own = {f.name for f in fields(LawParameters)}
        return tuple(getattr(self, f.name) for f in fields(self) if f.name not in own)


class PDLaw:
    """Joint PD control without gravity compensation, as on the robot itself.

    Args:
        arms: What is driven.
        gain: One position gain for all joints [Nm/rad]; None for the robot's own.
    """

    def __init__(self, arms: Arms, gain: float | None = None) -> None:
        kp = arms.kp if gain is None else torch.full_like(arms.kp, gain)
        self._kp, self._stiffness, self._damping = kp, torch.diag_embed(kp), torch.diag_embed(arms.kd)

    def __call__(self, state: ArmState, parameters: LawParameters) -> tuple[TorqueLaw, LawReport]:  # noqa: ARG002
        """`kp (target - q) - kd dq`."""
        n = state.position.shape[0]
        elastic = self._kp * (state.target - state.position)
        stiffness, damping = (m.expand(n, -1, -1, -1) for m in (self._stiffness, self._damping))
        return TorqueLaw(state.position, torch.zeros_like(elastic), elastic, stiffness, damping), LawReport()


class CoTaPLaw:
    """Task-space compliance blended with PD on the manifold of stiffness matrices (paper, section III).

    Args:
        arms: What is driven.
        cfg: Which error and which damping.
    """

    def __init__(self, arms: Arms, cfg: LawConfig) -> None:
        self._arms, self._cfg = arms, cfg
        alike = torch.equal(arms.kp, arms.kp[:, :1].expand_as(arms.kp))
        self._gains = arms.kp[:, 0] if alike else arms.kp  # (A,), which costs less, or (A, n)
        self._damping = torch.diag_embed(arms.kd)
        if cfg.rotational_stiffness and arms.chains.num_joints < 6:
            raise ValueError(f"rotational_stiffness asks for arms of at least 6 joints, got {arms.chains.num_joints}")

    @full_precision
    def __call__(self, state: ArmState, parameters: LawParameters) -> tuple[TorqueLaw, LawReport]:
        """Gravity plus `K` times the error, minus damping."""
        n = state.position.shape[0]
        felt, projected = _arm_stiffness(parameters.stiffness, state.base_compliance_h)
        blend = self._blend(state, felt, parameters)
        error = state.target - state.position
        if self._cfg.error == "task":
            error = self._task_error(state, blend, error)
        stiffness, error, held = self._in_force(state, blend.stiffness, error)
        up_t = state.to_heading[:, 2]
        elastic = (stiffness * error.unsqueeze(-2)).sum(-1)
        feedforward = gravity_torque(self._arms.inertias, state.pose, up_t)
        if self._cfg.damping == "critical":
            damping = critical_damping(stiffness, joint_inertia(self._arms.inertias, state.pose))
            if state.target_velocity is not None:
                feedforward = feedforward + (damping * state.target_velocity.unsqueeze(-2)).sum(-1)
        else:
            damping = self._damping.expand(n, -1, -1, -1)
        report = {
            "alpha": blend.ratio, "projected": projected.float(), "smallest_eigenvalue": blend.eigenvalue_range[..., 0],
            "largest_eigenvalue": blend.eigenvalue_range[..., 1],
        }  # fmt: skip
        return TorqueLaw(state.position, feedforward, elastic, stiffness, damping), LawReport(report | held)

    def _blend(self, state: ArmState, felt: torch.Tensor, parameters: LawParameters) -> ArmStiffness:
        """Of PD and of the compliance in which the hand is as stiff as `felt`, (N, A, 3) or (N, A, 3, 3) [N/m]."""
        n, cfg, null, alpha = state.position.shape[0], self._cfg, parameters.null_stiffness, parameters.alpha
        if cfg.rotational_stiffness:
            jacobian_h = pose_jacobian(state.pose, state.to_heading)
            return blended_pose_stiffness(
                jacobian_h, felt, cfg.rotational_stiffness, null, self._arms.kp.expand(n, -1, -1), alpha,
                cfg.condition_threshold, cfg.characteristic_length,
            )  # fmt: skip
        jacobian_h = state.to_heading.unsqueeze(1) @ self._arms.chains.jacobian(state.pose)
        pd = self._gains.expand(n, *self._gains.shape)
        return blended_stiffness(jacobian_h, felt, null, pd, alpha, cfg.condition_threshold)

    def _in_force(
        self, state: ArmState, stiffness: torch.Tensor, error: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
        """What of the stiffness asked for, and of the error, is put in force; and what to report of that."""
        del state
        return stiffness, error, {}

    def _task_error(self, state: ArmState, blend: ArmStiffness, joint_error: torch.Tensor) -> torch.Tensor:
        """`J# (x_target - x) + N (q_target - q)`; back to the joint error where the blend goes back to PD."""
        reach_t = self._arms.chains.pose(state.target).tip - state.pose.tip
        reach_h = (state.to_heading.unsqueeze(1) @ reach_t.unsqueeze(-1)).squeeze(-1)
        task = (blend.pseudo_inverse * reach_h.unsqueeze(-2)).sum(-1)
        task = task + (blend.null_projector * joint_error.unsqueeze(-2)).sum(-1)
        return torch.lerp(joint_error, task, blend.singularity.unsqueeze(-1))


LEAST_COMPLIANCE = 1e-4
"""What is left to an arm whose torso is more compliant than the hand is asked to be [m/N]: 10 kN/m."""


def _arm_stiffness(
    stiffness: torch.Tensor, base_compliance_h: torch.Tensor | None
) -> tuple[torch.Tensor, torch.Tensor]:
    """What the arm contributes, diagonal (N, A, 3) or full (N, A, 3, 3), and where (N, A) it had to be bounded."""
    if base_compliance_h is None:
        return stiffness, torch.zeros_like(stiffness[..., 0], dtype=torch.bool)
    left = torch.diag_embed(1.0 / stiffness.double()) - base_compliance_h.double()
    compliance, projected = project_compliance(left, LEAST_COMPLIANCE)
    return inverse_3x3(compliance.movedim((-2, -1), (0, 1))).movedim((0, 1), (-2, -1)), projected


def _cotap(arms: Arms, cfg: LawConfig) -> UpperBodyLaw:
    """With an energy store, or without."""
    if not cfg.passive:
        return CoTaPLaw(arms, cfg)
    from cotap.compliance.passive_law import PassiveCoTaPLaw  # brings torch's compiler, which takes a second

    return PassiveCoTaPLaw(arms, cfg)


def _facet(
    arms: Arms, cfg: LawConfig, tracking: UpperBodyLaw, model_scale: float = 1.0, tracking_scale: float = 1.0
) -> AdmittanceLaw:
    """The reference as a virtual mass, tracked by another law."""
    return AdmittanceLaw(arms, VirtualMass(cfg.virtual_mass, cfg.damping_ratio), tracking, model_scale, tracking_scale)


def _matched(arms: Arms, cfg: LawConfig) -> AdmittanceLaw:
    """Reference and arm each so stiff that their compliances add to the one that is asked for."""
    share = cfg.reference_share
    return _facet(arms, cfg, CoTaPLaw(arms, cfg), 1.0 / share, 1.0 / (1.0 - share))


LAWS: dict[str, Callable[[Arms, LawConfig], UpperBodyLaw]] = {
    "pd": lambda arms, _: PDLaw(arms),
    "soft-pd": lambda arms, cfg: PDLaw(arms, cfg.soft_gain),
    "cotap": _cotap,
    "facet": lambda arms, cfg: _facet(arms, cfg, PDLaw(arms)),
    "cotap+facet": lambda arms, cfg: _facet(arms, cfg, CoTaPLaw(arms, cfg)),
    "cotap+facet-matched": _matched,
    "hmc": lambda arms, cfg: BlendedTorqueLaw(arms, cfg.virtual_mass, cfg.damping_ratio),
    "dcc": lambda arms, _: AdmittanceLaw(arms, StaticShift(), PDLaw(arms)),
}
"""Every law, by name."""

_OF_COTAP = ("stiffness", "null_stiffness", "alpha", "condition_threshold", "error", "damping", "rotational_stiffness",
             "characteristic_length")  # fmt: skip
_OF_A_MASS = ("virtual_mass", "damping_ratio")
READS: dict[str, tuple[str, ...]] = {
    "pd": (),
    "soft-pd": ("soft_gain",),
    "cotap": (*_OF_COTAP, "passive", "store_energy", "store_power"),
    "facet": ("stiffness", *_OF_A_MASS, "sensing"),
    "cotap+facet": (*_OF_COTAP, *_OF_A_MASS, "sensing"),
    "cotap+facet-matched": (*_OF_COTAP, *_OF_A_MASS, "sensing", "reference_share"),
    "hmc": ("stiffness", "alpha", *_OF_A_MASS),
    "dcc": ("stiffness", "sensing"),
}
"""The fields of its `LawConfig` that each law reads; the others do nothing under it."""


def reads(law: str, field: str) -> bool:
    """Whether a law, by name, reads a field of its `LawConfig`; one that `READS` does not know may read all."""
    return field in READS.get(law, (field,))


WITHOUT_STIFFNESS = tuple(law for law, read in READS.items() if "stiffness" not in read)
"""Laws that command no stiffness of the hand."""

SENSING_FORCE = tuple(law for law, read in READS.items() if "sensing" in read)
"""Laws that move the hand's target by the force on it, and so must know that force."""
