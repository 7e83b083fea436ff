"""Everything from outside that acts on the robot, added up to one wrench per body: loads, pushes, punches, scripts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

# MuJoCo's extension module has no type stubs.
# pyright: reportAttributeAccessIssue=false
import mujoco
import torch

from cotap.envs.hand_loads import HandLoadConfig, HandLoads
from cotap.envs.punches import PunchConfig, Punches
from cotap.envs.pushes import PushConfig, Pushes
from cotap.envs.scripted_forces import ForceProfile, ScriptedForces
from cotap.envs.state import RobotState, StateReader
from cotap.robots import ROBOTS, RobotSpec
from cotap.robots.chains import LinkRotations
from cotap.rotations import rotate


@dataclass
class ExternalForceConfig:
    """Where forces come from."""

    hand_loads: HandLoadConfig = field(default_factory=HandLoadConfig)
    pushes: PushConfig = field(default_factory=PushConfig)
    punches: PunchConfig = field(default_factory=PunchConfig)
    scripted: ForceProfile = field(default_factory=ForceProfile)

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        for source in (self.hand_loads, self.pushes, self.punches, self.scripted):
            source.check()


class ExternalForces:
    """The sources of force, and the wrenches that they add up to.

    Args:
        cfg: The sources.
        spec: The robot.
        model: Its compiled model.
        reader: Reads its state.
        torque_limit: (A, n) of the arms' joints [Nm], which bound the loads on hands.
        num_envs: Number of envs.
        dt: Control step [s].
    """

    def __init__(
        self, cfg: ExternalForceConfig, spec: RobotSpec, model: mujoco.MjModel, reader: StateReader,
        torque_limit: torch.Tensor, num_envs: int, dt: float,
    ) -> None:  # fmt: skip
        self._cfg, self._chains, self._torque_limit = cfg, reader.arm_chains, torque_limit
        self._hand_bodies = [model.body(arm.hand_body).id for arm in spec.arms]
        links = {body.joint: body for body in spec.bodies}
        struck = [links[name] for name in spec.joint_names]
        self._joint_bodies = torch.tensor([model.body(link.name).id for link in struck])
        self._joint_coms = torch.tensor([link.com for link in struck])
        self._link_rotations = LinkRotations(spec)
        self._hand_levers = torch.stack(
            [torch.tensor(arm.hand_point) - torch.tensor(spec.body(arm.hand_body).com) for arm in spec.arms]
        )
        base = model.body(spec.base_body).id
        moving = [model.body(body.name).id for body in spec.bodies]
        hands = len(spec.arms)
        self._place_bodies = torch.tensor([base, *self._hand_bodies, *moving])
        """The body that each of a push's places is on."""
        self._base = base
        self.hand_loads = HandLoads(cfg.hand_loads, hands, num_envs, dt, spec.mass_kg / ROBOTS["h1"]().mass_kg)
        self.pushes = Pushes(cfg.pushes, hands, len(moving), spec.mass_kg, num_envs, dt)
        self.punches = Punches(cfg.punches, len(spec.joints), num_envs, dt)
        self.scripted = ScriptedForces(cfg.scripted, tuple(arm.side for arm in spec.arms), num_envs, dt)
        self.hand_force_w = torch.zeros(num_envs, hands, 3)
        """(N, H, 3) force at each hand in the last step, world frame [N]."""
        self.hand_push_w = torch.zeros_like(self.hand_force_w)
        """(N, H, 3) what of that is a push."""

    @property
    def parts(self) -> dict[str, Any]:
        """The sources that have a state, by name."""
        return {name: getattr(self, name) for name in ("hand_loads", "pushes", "scripted")}

    def reset(self, mask: torch.Tensor, rng: torch.Generator) -> None:
        """Episodes begin in the envs of `mask`."""
        for source in self.parts.values():
            source.reset(mask, rng)
        self.hand_force_w = torch.where(mask[:, None, None], torch.zeros_like(self.hand_force_w), self.hand_force_w)

    def step(self, samples: float, rng: torch.Generator) -> None:
        """Advance the sources by one control step."""
        self.hand_loads.step(rng)
        self.pushes.step(samples, rng)

    def ahead(self, heading_w: torch.Tensor, samples: float) -> torch.Tensor:
        """What critics see of pushes and loads to come, (N, 7 + 4 hands) as their `ahead` say."""
        return torch.cat((self.pushes.ahead(heading_w, samples), self.hand_loads.ahead(samples)), 1)

    def apply(self, xfrc: torch.Tensor, s: RobotState, time_s: torch.Tensor, samples: float) -> None:
        """Write the wrenches of the coming control step.

        Args:
            xfrc: (N, bodies, 6) the simulation's wrenches at centres of mass, world frame; replaced.
            s: The state now.
            time_s: (N,) since each env's start [s].
            samples: How far training has come.
        """
        xfrc.zero_()
        hands_h = torch.zeros_like(self.hand_force_w)
        if self._cfg.hand_loads.enabled:
            to_heading = s.torso_to_heading
            jacobian_h = to_heading.unsqueeze(1) @ self._chains.jacobian(s.arms)
            hands_h = self.hand_loads.current(jacobian_h, self._torque_limit, samples)
        if self.scripted.active:
            scripted_h = self.scripted.at(time_s)
            hands_h = hands_h + scripted_h[:, :-1]
            xfrc[:, self._base, :3] += rotate(s.heading_w, scripted_h[:, -1]).to(xfrc)
        self.hand_force_w = (s.heading_w.unsqueeze(1) @ hands_h.unsqueeze(-1)).squeeze(-1)
        if self._cfg.pushes.enabled:
            self._push(xfrc)
        if self.punches.active:
            self._punch(xfrc, s, time_s)
        lever_w = rotate(s.torso_rotation_w.unsqueeze(1) @ s.arms.rotation, self._hand_levers)
        wrench = torch.cat((self.hand_force_w, torch.linalg.cross(lever_w, self.hand_force_w)), 2).to(xfrc)
        for i, body in enumerate(self._hand_bodies):
            xfrc[:, body] += wrench[:, i]

    def _push(self, xfrc: torch.Tensor) -> None:
        """Pushes on hands count as forces on hands; all others act at centres of mass."""
        force_w, place, hands = self.pushes.current(), self.pushes.place, self.hand_force_w.shape[1]
        on_hand = torch.nn.functional.one_hot(place, len(self._place_bodies))[:, 1 : 1 + hands]
        self.hand_push_w = on_hand.unsqueeze(2) * force_w.unsqueeze(1)
        self.hand_force_w = self.hand_force_w + self.hand_push_w
        rows = torch.arange(len(place), device=place.device)
        elsewhere = ~on_hand.any(1, keepdim=True) * force_w
        xfrc[rows, self._place_bodies[place], :3] += elsewhere.to(xfrc)

    def _punch(self, xfrc: torch.Tensor, s: RobotState, time_s: torch.Tensor) -> None:
        """Punches act at joints, which are the origins of the links' frames."""
        joint, force_w = self.punches.at(time_s)
        if not force_w.any():
            return
        rows = torch.arange(len(joint), device=joint.device)
        rotation_w = self._link_rotations(s.base_rotation_w, s.joint_pos)[rows, joint]
        lever_w = -rotate(rotation_w, self._joint_coms[joint])
        xfrc[rows, self._joint_bodies[joint]] += torch.cat((force_w, torch.linalg.cross(lever_w, force_w)), 1).to(xfrc)
