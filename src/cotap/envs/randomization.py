"""Domain randomisation (paper, Table II): each randomiser declares the model fields that it writes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch

from cotap.checks import require_interval, require_range
from cotap.persistence import Stateful, uniform
from cotap.robots import RobotSpec
from cotap.sim import Simulation


@dataclass
class RandomizationConfig:
    """Ranges, drawn uniformly per env: body properties once, the others at every episode."""

    enabled: bool = True
    """Whether envs differ at all."""
    friction: tuple[float, float] = (0.5, 1.25)
    """Sliding friction of the feet."""
    link_mass_scale: tuple[float, float] = (0.9, 1.2)
    """Factor on each link's mass and inertia."""
    base_mass_kg: tuple[float, float] = (-1.0, 3.0)
    """Added to the torso link, the paper's base [kg]."""
    delay_s: tuple[float, float] = (0.0, 0.02)
    """Control delay [s], at most one control step."""
    kp_scale: tuple[float, float] = (0.9, 1.1)
    """Factor on each joint's position gain."""
    kd_scale: tuple[float, float] = (0.9, 1.1)
    """Factor on each joint's damping gain."""

    def check(self, control_dt: float) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        for name in ("friction", "link_mass_scale", "base_mass_kg", "delay_s", "kp_scale", "kd_scale"):
            require_interval(f"randomization.{name}", getattr(self, name))
        for name in ("friction", "link_mass_scale", "kp_scale", "kd_scale"):
            require_range(f"randomization.{name}[0]", getattr(self, name)[0], 1e-3, 1e3)
        for i in range(2):
            require_range(f"randomization.delay_s[{i}]", self.delay_s[i], 0.0, control_dt)


class Randomizer(Stateful):
    """Draws and writes the randomised parameters; holds those that are not model fields."""

    FIELDS: ClassVar[tuple[str, ...]] = ("geom_friction", "body_mass", "body_inertia", "actuator_biasprm")
    STATE = ("kp_scale", "kd_scale")

    def __init__(self, cfg: RandomizationConfig, spec: RobotSpec, sim: Simulation) -> None:
        cfg.check(sim.dt)
        self.cfg, self._sim = cfg, sim
        model = sim.model
        feet = {model.body(foot.body).id for foot in spec.feet}
        self._foot_geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] in feet and model.geom_contype[g]]
        self._torso = model.body(spec.torso_body).id
        lightest = model.body_mass[self._torso] * cfg.link_mass_scale[0] + cfg.base_mass_kg[0]
        if cfg.enabled and lightest <= 0.0:
            raise ValueError(
                f"randomization.base_mass_kg[0] {cfg.base_mass_kg[0]} would leave a torso of {lightest:.1f} kg"
            )
        self._kp = torch.tensor([j.kp for j in spec.joints], dtype=torch.float64)
        self._kd = torch.tensor([j.kd for j in spec.joints], dtype=torch.float64)
        self.kp_scale = torch.ones(sim.num_envs, len(spec.joints))
        self.kd_scale = torch.ones(sim.num_envs, len(spec.joints))

    def randomize_bodies(self, rng: torch.Generator) -> None:
        """Draw masses and inertias of all envs; slow, so done once."""
        cfg = self.cfg
        if not cfg.enabled:
            return
        n, bodies = self._sim.field("body_mass").shape
        scale = uniform(rng, *cfg.link_mass_scale, n, bodies)
        self.set_mass(scale, uniform(rng, *cfg.base_mass_kg, n))

    def set_mass(self, scale: torch.Tensor, added_kg: torch.Tensor) -> None:
        """Give every env's links their nominal mass and inertia times `scale` (N, bodies), the torso more (N,)."""
        mass, inertia = self._sim.field("body_mass"), self._sim.field("body_inertia")
        nominal = torch.as_tensor(self._sim.model.body_mass, device=mass.device)
        scaled = nominal * scale.double()
        # Mass added to the torso is spread as the torso's own.
        scaled[:, self._torso] += added_kg.double()
        ratio = torch.where(nominal > 0.0, scaled / nominal.clamp_min(1e-12), torch.ones_like(scaled))
        mass.copy_(scaled)
        inertia.copy_(torch.as_tensor(self._sim.model.body_inertia, device=mass.device) * ratio.unsqueeze(-1))
        self._sim.update_constants()

    def randomize_episode(self, mask: torch.Tensor, delay_s: torch.Tensor, rng: torch.Generator) -> None:
        """Draw friction, gains and delay of the envs in `mask`; `delay_s` (num_envs,) is written in place."""
        cfg, n = self.cfg, int(mask.sum())
        if n == 0 or not cfg.enabled:
            return
        joints = self.kp_scale.shape[1]
        self.set_friction(mask, uniform(rng, *cfg.friction, n))
        self.kp_scale[mask] = uniform(rng, *cfg.kp_scale, n, joints)
        self.kd_scale[mask] = uniform(rng, *cfg.kd_scale, n, joints)
        delay_s[mask] = uniform(rng, *cfg.delay_s, n)
        self.write_gains(mask)

    def set_friction(self, mask: torch.Tensor, sliding: torch.Tensor) -> None:
        """Give the feet in the envs of `mask` (N,) the sliding friction `sliding` (n,)."""
        friction = self._sim.field("geom_friction")
        for geom in self._foot_geoms:
            friction[mask, geom, 0] = sliding.to(friction)

    def set_nominal_gains(self, joints: slice, kp: torch.Tensor, kd: torch.Tensor) -> None:
        """Give `joints` other nominal gains (n,) [Nm/rad, Nms/rad] than the robot's, in all envs."""
        self._kp[joints], self._kd[joints] = kp.to(self._kp), kd.to(self._kd)
        self.write_gains(torch.ones(len(self.kp_scale), dtype=torch.bool, device=self.kp_scale.device))

    def write_gains(self, mask: torch.Tensor) -> None:
        """Bring the actuators' gains of the envs in `mask` in line with the scales."""
        bias = self._sim.field("actuator_biasprm")
        bias[mask, :, 1] = (-self._kp * self.kp_scale[mask].double()).to(bias)
        bias[mask, :, 2] = (-self._kd * self.kd_scale[mask].double()).to(bias)

    def gains(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Present kp [Nm/rad] and kd [Nms/rad] of every joint, (N, J) each."""
        return self._kp.float() * self.kp_scale, self._kd.float() * self.kd_scale
