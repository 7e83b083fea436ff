"""The arms' laws inside the environment: chosen by name per arm, parameters per env, torque at the physics rate."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from cotap.checks import require_interval, require_one_of, require_range
from cotap.compliance.interface import ArmState, LawParameters, Remembering, TorqueLaw, UpperBodyLaw
from cotap.compliance.laws import LAWS, WITHOUT_STIFFNESS, LawConfig
from cotap.compliance.torso import chain_compliance, hand_base_compliance, torso_compliance
from cotap.envs.hand_sensing import HandSensors
from cotap.envs.modulation import Modulation, ModulationConfig
from cotap.envs.state import RobotState
from cotap.persistence import Stateful, restored, uniform
from cotap.robots import RobotSpec
from cotap.robots.chains import arm_model, chains_between

TORSO_MODELS = ("none", "constant", "support")


@dataclass
class TorsoComplianceConfig:
    """What of the hand's compliance is put down to the torso, and so not left to the arm."""

    model: str = "none"
    """none: stiffness is against the torso. constant: `stiffness` below. support: from the legs on the ground."""
    stiffness: tuple[float, float, float, float, float, float] = (5e3, 5e3, 2e4, 500.0, 500.0, 300.0)
    """The torso's stiffness against the ground, along [N/m] and about [Nm/rad] x, y and z of the heading frame."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_one_of("upper_body.torso.model", self.model, TORSO_MODELS)
        for i, value in enumerate(self.stiffness):
            require_range(f"upper_body.torso.stiffness[{i}]", value, 1.0, 1e9)


@dataclass
class LawSampling:
    """Parameters of laws drawn at random, per env and arm, at every episode and again within it."""

    enabled: bool = False
    """Whether they are drawn; otherwise they stay as the laws' configs have them."""
    stiffness: tuple[float, float] = (80.0, 1200.0)
    """Hand stiffness, each axis by itself [N/m]."""
    log_uniform: bool = True
    """Draw the logarithm of stiffness uniformly, or else (the paper) stiffness itself."""
    null_stiffness: tuple[float, float] = (24.0, 56.0)
    """Null-space stiffness, uniform [Nm/rad]."""
    alpha: tuple[float, float] = (0.0, 1.0)
    """Share of compliance in the blend with PD, uniform."""
    full_alpha: float = 0.0
    """Share of the draws that take the largest alpha instead, as evaluations of compliance alone do."""
    hold_s: tuple[float, float] = (2.0, 6.0)
    """Time between changes [s]."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        for name in ("stiffness", "null_stiffness", "alpha", "hold_s"):
            require_interval(f"upper_body.sampling.{name}", getattr(self, name))
        require_range("upper_body.sampling.stiffness[0]", self.stiffness[0], 1.0, 1e5)
        require_range("upper_body.sampling.null_stiffness[0]", self.null_stiffness[0], 0.1, 1e4)
        for i, value in enumerate(self.alpha):
            require_range(f"upper_body.sampling.alpha[{i}]", value, 0.0, 1.0)
        require_range("upper_body.sampling.full_alpha", self.full_alpha, 0.0, 1.0)
        require_range("upper_body.sampling.hold_s[0]", self.hold_s[0], 0.02, 1e6)


@dataclass
class UpperBodyConfig:
    """Which law drives which arm."""

    left: LawConfig = field(default_factory=LawConfig)
    right: LawConfig = field(default_factory=LawConfig)
    torso: TorsoComplianceConfig = field(default_factory=TorsoComplianceConfig)
    sampling: LawSampling = field(default_factory=LawSampling)
    modulation: ModulationConfig = field(default_factory=ModulationConfig)
    singularity_ratio: bool = True
    """Whether compliance gives way to PD near singular arms (paper, equation 10); False for its ablation, the paper's
    law without it."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        self.left.check("upper_body.left")
        self.right.check("upper_body.right")
        self.torso.check()
        self.sampling.check()
        self.modulation.check({"left": self.left, "right": self.right}, self.sampling.enabled)

    def of(self, side: str) -> LawConfig:
        """The law of the arm on `side`."""
        return {"left": self.left, "right": self.right}[side]

    def built(self, law: LawConfig) -> LawConfig:
        """`law`, with an infinite condition threshold if `singularity_ratio` is off: alpha is kept near singular arms,
        and pseudo-inverses are not damped there, except under a `rotational_stiffness`."""
        return law if self.singularity_ratio else replace(law, condition_threshold=math.inf)


class UpperBody(Stateful):
    """Asks each arm's law once a control step and gives its torque at every physics step.

    `parameters` are per-env tensors that anyone may write to at any step. A command that is late (control delay) is
    mixed with the one before it by the time that each holds, as with PD targets.
    """

    PAIRED = ("_anchor", "_feedforward", "_elastic", "_stiffness", "_damping")
    """Of the command before and the newest: (2, N, ...)."""
    STATE = ("fresh", "_hold_s", *PAIRED)

    def __init__(
        self, cfg: UpperBodyConfig, spec: RobotSpec, num_envs: int, dt: float, dtype: torch.dtype = torch.float32
    ) -> None:
        cfg.check()
        self._cfg, self._spec, self._dt = cfg, spec, dt
        self.arms = arm_model(spec, dtype)
        configs = [cfg.of(arm.side) for arm in spec.arms]
        self.sensors = HandSensors(self.arms, num_envs, dt, any(c.sensing == "estimated" for c in configs))
        n, a, j = num_envs, len(configs), len(spec.arms[0].joints)
        self._shape = (n, a, j)
        self._laws: dict[tuple[object, ...], tuple[UpperBodyLaw, LawConfig, torch.Tensor]] = {}
        for i, c in enumerate(configs):
            self._mask(c)[:, i] = True
        self.parameters = LawParameters(
            torch.tensor([c.stiffness for c in configs], dtype=dtype).repeat(n, 1, 1),
            torch.tensor([c.null_stiffness for c in configs], dtype=dtype).repeat(n, 1),
            torch.tensor([c.alpha for c in configs], dtype=dtype).repeat(n, 1),
        )
        self.modulation = Modulation(cfg.modulation, configs, dt, dtype)
        self.fresh = torch.ones(n, a, dtype=torch.bool)
        # Two torque laws, the one in force and the one before it: (2, N, A, n[, n]).
        self._anchor, self._feedforward, self._elastic = (torch.zeros(2, n, a, j, dtype=dtype) for _ in range(3))
        self._stiffness, self._damping = (torch.zeros(2, n, a, j, j, dtype=dtype) for _ in range(2))
        self._hold_s = torch.zeros(n)
        self._torso = _TorsoModel(cfg.torso, spec, dtype)
        self.log: dict[str, torch.Tensor] = {}
        """Means over envs and arms of what the laws report about the last step, and of what policies ask of them."""
        self.report: dict[str, torch.Tensor] = {}
        """The same of every arm (N, A); NaN where its law reports nothing of that name."""

    def set_law(self, env: int, arm: int, law: LawConfig) -> None:
        """Put one arm of one env under another law, or other parameters, from the next command on.

        An arm in motion takes no full energy store along: see `PassiveCoTaPLaw.take_over`.

        Raises:
            ValueError: a field of `law` is out of its range.
        """
        law.check()
        under_it = self._mask(law)  # which refuses a law that these arms cannot have, before anything is changed
        p = self.parameters
        p.stiffness[env, arm] = torch.tensor(law.stiffness)
        p.null_stiffness[env, arm], p.alpha[env, arm] = law.null_stiffness, law.alpha
        if under_it[env, arm]:
            return
        memory: dict[str, torch.Tensor] = {}
        for before, _, mine in self._laws.values():
            if mine[env, arm] and isinstance(before, Remembering):
                memory = before.memory
            mine[env, arm] = False
        under_it[env, arm] = True
        now, moving = self._laws[law.kind()][0], not self.fresh[env, arm]
        known = moving and isinstance(now, Remembering) and now.take_over(env, arm, memory, self._anchor[1])
        self.fresh[env, arm] = not known
        self.report = {}
        self._laws = {kind: driven for kind, driven in self._laws.items() if driven[2].any()}
        self.sensors.estimates = any(config.sensing == "estimated" for _, config, _ in self._laws.values())

    @property
    def active(self) -> bool:
        """Whether any arm is under a law that plain PD actuators do not implement by themselves."""
        return any(config.name != "pd" for _, config, _ in self._laws.values())

    @property
    def compliant(self) -> torch.Tensor:
        """(N, A) bool: the arm is under a law that commands a stiffness of its hand."""
        none = torch.zeros(self._shape[:2], dtype=torch.bool, device=self.arms.kp.device)
        masks = [mine for _, config, mine in self._laws.values() if config.name not in WITHOUT_STIFFNESS]
        return torch.stack([none, *masks]).any(0)

    @property
    def stiffness(self) -> torch.Tensor:
        """(N, A, n, n) joint stiffness that the newest command asks for [Nm/rad]; zero while not `active`."""
        return self._stiffness[1]

    def reset(self, mask: torch.Tensor, rng: torch.Generator) -> None:
        """The next command of the envs in `mask` has none before it; their parameters begin anew."""
        self.fresh = self.fresh | mask.unsqueeze(1)
        self.sensors.reset(mask)
        self.modulation.reset(self.parameters, mask)
        if self._cfg.sampling.enabled:
            self._sample(mask, rng)

    def step(self, rng: torch.Generator) -> None:
        """Advance the clock of the parameters by one control step."""
        if self._cfg.sampling.enabled:
            self._hold_s = self._hold_s - self._dt
            self._sample(self._hold_s <= 0.0, rng)

    def modulate(self, action: torch.Tensor) -> None:
        """With learned modulation, bring the parameters closer to what actions (N, M) ask for."""
        if self.modulation.active:
            self.modulation.approach(self.parameters, self.modulation.wanted(action))

    def _sample(self, mask: torch.Tensor, rng: torch.Generator) -> None:
        n, arms = int(mask.sum()), self._shape[1]
        if n == 0:
            return
        cfg, p = self._cfg.sampling, self.parameters
        low, high = (math.log(bound) for bound in cfg.stiffness) if cfg.log_uniform else cfg.stiffness
        drawn = uniform(rng, low, high, n, arms, 3)
        p.stiffness[mask] = drawn.exp() if cfg.log_uniform else drawn
        p.null_stiffness[mask] = uniform(rng, *cfg.null_stiffness, n, arms)
        full = torch.rand(n, arms, generator=rng, device=rng.device) < cfg.full_alpha
        p.alpha[mask] = torch.where(full, cfg.alpha[1], uniform(rng, *cfg.alpha, n, arms))
        self._hold_s[mask] = uniform(rng, *cfg.hold_s, n)

    def send(self, state: RobotState, target: torch.Tensor, velocity: torch.Tensor) -> None:
        """Ask the laws, for targets (N, U) sent at the start of a control step, of a reference that moves at `velocity`
        (N, U) [rad/s]."""
        q, dq, wanted, rate = (
            x.reshape(self._shape)
            for x in (self._upper(state.joint_pos), self._upper(state.joint_vel), target, velocity)
        )
        to_heading = state.torso_to_heading
        base = self._torso.hand_compliance(state, to_heading)
        arms = ArmState(
            q, dq, wanted, state.arms, to_heading, base, target_velocity=rate, fresh=self.fresh, dt=self._dt
        )
        new, self.report = self._ask(arms)
        self.log = {f"/law/{name}": values.nanmean() for name, values in self.report.items()}
        if self.modulation.active:
            p = self.parameters
            self.log |= {"/law/asked_alpha": p.alpha.mean(), "/law/asked_stiffness": p.stiffness.log().mean().exp()}
        tensors = (new.anchor, new.feedforward, new.elastic, new.stiffness, new.damping)
        for name, value in zip(self.PAIRED, tensors, strict=True):
            held: torch.Tensor = getattr(self, name)
            before = torch.where(self.fresh[(..., *[None] * (value.dim() - 2))], value, held[1])
            setattr(self, name, torch.stack((before, value)))
        self.fresh = torch.zeros_like(self.fresh)

    def sense(self, state: RobotState, force_w: torch.Tensor, effort: torch.Tensor) -> None:
        """Let the laws know what has just happened to the arms.

        Args:
            state: At the end of a control step.
            force_w: (N, A, 3) on the hands during it, world frame [N].
            effort: (N, U) mean torque of the arms' motors over it [Nm]; read only for estimates of the force.
        """
        q, dq = (self._upper(x).reshape(self._shape) for x in (state.joint_pos, state.joint_vel))
        self.sensors.sense(state, q, dq, force_w, effort.reshape(self._shape))

    def torque(
        self, q: torch.Tensor, dq: torch.Tensor, arrived: torch.Tensor, kp_scale: torch.Tensor, kd_scale: torch.Tensor
    ) -> torch.Tensor:
        """Arm torques (N, U) [Nm], limits aside.

        Args:
            q: (N, U) arm joint angles now [rad].
            dq: (N, U) [rad/s].
            arrived: (N,) share of the present physics step in which the newest command holds.
            kp_scale: (N, U) factors on the joints' elastic torque.
            kd_scale: (N, U) factors on the joints' damping.
        """
        state = [x.reshape(self._shape) for x in (q, dq, kp_scale, kd_scale)]
        new = self._law(1).at(*state)
        if not (arrived < 1.0).any():
            return new.flatten(1)
        return torch.lerp(self._law(0).at(*state), new, arrived[:, None, None]).flatten(1)

    @property
    def newest(self) -> TorqueLaw:
        """What the laws answered last."""
        return self._law(1)

    def implicit_damping(self) -> torch.Tensor:
        """Diagonal (N, U) of the damping in force, which the simulator integrates implicitly."""
        return torch.diagonal(self._damping[1], dim1=-2, dim2=-1).flatten(1)

    def state_dict(self) -> dict[str, Any]:
        """Its own state, the laws' parameters and memories, and what hands have felt."""
        p = self.parameters
        own = {"stiffness": p.stiffness.clone(), "null_stiffness": p.null_stiffness.clone(), "alpha": p.alpha.clone()}
        memories = [{k: v.clone() for k, v in law.memory.items()} for law in self._remembering()]
        return super().state_dict() | {
            "parameters": own, "sensors": self.sensors.state_dict(), "memories": memories,
        }  # fmt: skip

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` returned. Raises ValueError for another size or a missing name."""
        own = dict(state)
        saved, present = own.pop("parameters"), vars(self.parameters)
        if saved.keys() != present.keys():
            raise ValueError(f"UpperBody.parameters expects {sorted(present)}, got {sorted(saved)}")
        parameters = {k: restored(f"UpperBody.parameters.{k}", saved[k], v) for k, v in present.items()}
        self.sensors.load_state_dict(own.pop("sensors", {}))
        memories, remembering = own.pop("memories", []), self._remembering()
        if len(memories) != len(remembering):
            raise ValueError(f"the arms' laws remember {len(remembering)} states, got {len(memories)}")
        for law, memory in zip(remembering, memories, strict=True):
            law.memory = {k: v.to(self.fresh.device, copy=True) for k, v in memory.items()}
        super().load_state_dict(own)
        self.parameters = LawParameters(**parameters)

    def _remembering(self) -> list[Remembering]:
        return [law for law, *_ in self._laws.values() if isinstance(law, Remembering)]

    def _upper(self, joints: torch.Tensor) -> torch.Tensor:
        return joints[:, len(self._spec.lower_joints) :]

    def _law(self, which: int) -> TorqueLaw:
        return TorqueLaw(
            self._anchor[which],
            self._feedforward[which],
            self._elastic[which],
            self._stiffness[which],
            self._damping[which],
        )

    def _mask(self, law: LawConfig) -> torch.Tensor:
        """The arms (N, A) under laws of one kind, to write to; none at first."""
        kind = law.kind()
        if kind not in self._laws:
            nobody = torch.zeros(self._shape[:2], dtype=torch.bool, device=self.arms.kp.device)
            self._laws[kind] = (LAWS[law.name](self.arms, self._cfg.built(law)), law, nobody)
        return self._laws[kind][2]

    def _ask(self, arms: ArmState) -> tuple[TorqueLaw, dict[str, torch.Tensor]]:
        """Every law for all arms; each arm keeps its own's answer and report."""
        merged: TorqueLaw | None = None
        reports: dict[str, torch.Tensor] = {}
        for law, config, mine in self._laws.values():
            force = self.sensors.estimated if config.sensing == "estimated" else self.sensors.privileged
            answer, report = law(replace(arms, hand_force_h=force), self.parameters)
            for name, values in report.values.items():
                reports[name] = torch.where(mine, values, reports.get(name, torch.nan))
            merged = answer if merged is None else _choose(mine, answer, merged)
        assert merged is not None
        return merged, reports


def _choose(mine: torch.Tensor, answer: TorqueLaw, other: TorqueLaw) -> TorqueLaw:
    """`answer` for the arms in `mine` (N, A), `other` for the rest."""
    vector, matrix = mine[..., None], mine[..., None, None]
    return TorqueLaw(
        torch.where(vector, answer.anchor, other.anchor),
        torch.where(vector, answer.feedforward, other.feedforward),
        torch.where(vector, answer.elastic, other.elastic),
        torch.where(matrix, answer.stiffness, other.stiffness),
        torch.where(matrix, answer.damping, other.damping),
    )


class _TorsoModel:
    """The hands' compliance through the torso, in the heading frame."""

    def __init__(self, cfg: TorsoComplianceConfig, spec: RobotSpec, dtype: torch.dtype = torch.float32) -> None:
        self._cfg = cfg
        gains = {j.name: j.kp for j in spec.joints}
        self._constant = torch.diag(1.0 / torch.tensor(cfg.stiffness, dtype=dtype))
        chains = [spec.chain(foot.body, spec.base_body) for foot in spec.feet]
        names = [[b.joint or "" for b in chain] for chain in chains]
        self._legs = chains_between(spec, spec.base_body, [(f.body, f.sole) for f in spec.feet], dtype)
        self._leg_joints = torch.tensor([spec.indices(chain) for chain in names])
        self._leg_gains = torch.tensor([[gains[n] for n in chain] for chain in names], dtype=dtype)
        self._waist = chains_between(spec, spec.base_body, [(spec.torso_body, (0.0, 0.0, 0.0))], dtype)
        self._waist_joints = torch.tensor([spec.indices(spec.waist_joints)])
        self._waist_gains = torch.tensor([[gains[n] for n in spec.waist_joints]], dtype=dtype)

    def hand_compliance(self, s: RobotState, to_heading: torch.Tensor) -> torch.Tensor | None:
        """(N, A, 3, 3) [m/N], or None where stiffness is against the torso."""
        if self._cfg.model == "none":
            return None
        lever_h = s.arms.tip @ to_heading.transpose(1, 2)
        if self._cfg.model == "constant":
            return hand_base_compliance(self._constant.expand(lever_h.shape[0], 6, 6), lever_h)
        return hand_base_compliance(self._support(s), lever_h)

    def _support(self, s: RobotState) -> torch.Tensor:
        base_to_heading = (s.heading_w.transpose(1, 2) @ s.base_rotation_w).unsqueeze(1)
        legs = self._legs.pose(s.joint_pos[:, self._leg_joints])
        waist = self._waist.pose(s.joint_pos[:, self._waist_joints])
        torso = waist.tip
        spring = []
        for pose, gains in ((legs, self._leg_gains), (waist, self._waist_gains)):
            axes = pose.axes @ base_to_heading.transpose(-1, -2)
            anchors = (pose.anchors - torso.unsqueeze(2)) @ base_to_heading.transpose(-1, -2)
            spring.append(chain_compliance(axes, anchors, gains, torch.zeros_like(anchors[:, :, 0])))
        return torso_compliance(spring[0], spring[1][:, 0], s.foot_contact)
