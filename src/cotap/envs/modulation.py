"""Learned modulation: what the upper agent's action sets of the arms' laws, within bounds and at a bounded rate."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import torch
import tyro

from cotap.checks import require_interval, require_one_of, require_range
from cotap.compliance.interface import LawParameters
from cotap.compliance.laws import LawConfig, reads
from cotap.envs.observations import Term

PER_ARM = {"none": 0, "alpha": 1, "stiffness": 4}
"""Actions per arm, in addition to its joints': for alpha, and for stiffness along x, y and z."""
OBSERVED_STIFFNESS = 300.0
"""Stiffness whose logarithm is observed as zero [N/m]."""


@dataclass
class ModulationConfig:
    """What of the arms' laws the policy sets. A zero action asks for what the laws are configured with."""

    kind: str = "none"
    """none; alpha; or stiffness: alpha, and the logarithm of the hand's stiffness along x, y and z."""
    alpha: tuple[float, float] = (0.0, 1.0)
    """Bounds of alpha."""
    stiffness: tuple[float, float] = (80.0, 1200.0)
    """Bounds of stiffness [N/m]."""
    alpha_scale: float = 0.5
    """Alpha per unit of action."""
    stiffness_scale: float = 1.0
    """Logarithm of stiffness per unit of action."""
    alpha_rate: float = 4.0
    """Largest change of alpha per second."""
    stiffness_rate: float = 10.0
    """Largest change of the logarithm of stiffness per second."""
    held: Annotated[bool, tyro.conf.Suppress] = False
    """Laws stay as they are configured, whatever the policy asks for; evaluations of constant settings set it."""

    def check(self, laws: Mapping[str, LawConfig], drawn: bool) -> None:
        """Raise ValueError naming the first field that is out of its range, or does not go with the arms' `laws`, by
        side, or with parameters that are `drawn` at random."""
        where = "upper_body.modulation"
        require_one_of(f"{where}.kind", self.kind, PER_ARM.keys())
        for name, lowest, highest in (("alpha", 0.0, 1.0), ("stiffness", 1.0, 1e5)):
            bounds = getattr(self, name)
            require_interval(f"{where}.{name}", bounds)
            for i, value in enumerate(bounds):
                require_range(f"{where}.{name}[{i}]", value, lowest, highest)
        for name in ("alpha_scale", "stiffness_scale", "alpha_rate", "stiffness_rate"):
            require_range(f"{where}.{name}", getattr(self, name), 1e-3, 1e3)
        if self.kind == "none" or self.held:
            return
        if drawn:
            raise ValueError(f"{where}.kind {self.kind!r} sets what upper_body.sampling draws; switch one of them off")
        for side, law in laws.items():
            for name in ("alpha", "stiffness")[: 1 + (self.kind == "stiffness")]:
                if not reads(law.name, name):
                    raise ValueError(f"{where}.kind {self.kind!r}: {law.name}, the {side} arm's law, reads no {name}")
            require_range(f"upper_body.{side}.alpha, which a zero action asks for,", law.alpha, *self.alpha)
            for i, value in enumerate(law.stiffness if self.kind == "stiffness" else ()):
                require_range(
                    f"upper_body.{side}.stiffness[{i}], which a zero action asks for,", value, *self.stiffness
                )

    def hold(self) -> None:
        """From now on laws stay as they are configured."""
        self.held = self.kind != "none"

    def targets(self, sides: Sequence[str]) -> list[str]:
        """What each action asks for, in words, for arms of these `sides`; none without modulation."""
        named = ["alpha", *(f"natural logarithm of stiffness along {axis} [N/m]" for axis in "xyz")]
        return [f"{side} {name}" for side in sides for name in named[: PER_ARM[self.kind]]]

    def terms(self, arms: int) -> tuple[Term, ...]:
        """What actors observe of the laws of so many `arms`."""
        shown = (("law_alpha", arms, 1.0), ("law_log_stiffness", 3 * arms, 1.0))
        return shown[: list(PER_ARM).index(self.kind)]

    def layout(self, sides: Sequence[str]) -> dict[str, Any]:
        """What a policy must agree with, as plain data; nothing without modulation."""
        if self.kind == "none":
            return {}
        own: dict[str, Any] = asdict(self) | {"alpha": list(self.alpha), "stiffness": list(self.stiffness)}
        del own["held"]
        return {"modulation": own | {"targets": self.targets(sides)}}


class Modulation:
    """Moves laws' parameters towards what is asked for. Vectors (M,) run arm by arm: alpha, logarithms of stiffness.

    Args:
        cfg: What is set, and within which bounds.
        laws: Of every arm, in order.
        dt: Control step [s].
        dtype: Of the laws' parameters.
    """

    def __init__(
        self, cfg: ModulationConfig, laws: Sequence[LawConfig], dt: float, dtype: torch.dtype = torch.float32
    ) -> None:
        self.cfg, self._per_arm, arms = cfg, PER_ARM[cfg.kind], len(laws)

        def vector(alpha: float, stiffness: float) -> torch.Tensor:
            return torch.tensor([alpha, *[stiffness] * 3][: self._per_arm] * arms, dtype=dtype)

        own = [[law.alpha, *map(math.log, law.stiffness)][: self._per_arm] for law in laws]
        self._zero = torch.tensor(own, dtype=dtype).flatten()
        self._low, self._high = (vector(cfg.alpha[i], math.log(cfg.stiffness[i])) for i in (0, 1))
        self._scale = vector(cfg.alpha_scale, cfg.stiffness_scale)
        self._most = vector(cfg.alpha_rate * dt, cfg.stiffness_rate * dt)
        self.size = len(self._zero)
        """M, the number of actions."""

    @property
    def active(self) -> bool:
        """Whether actions set anything."""
        return self.size > 0 and not self.cfg.held

    def wanted(self, action: torch.Tensor) -> torch.Tensor:
        """What actions (N, M) ask for, within the bounds (N, M)."""
        return (self._zero + self._scale * action).clamp(self._low, self._high)

    @property
    def action_bounds(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Lowest and highest action (M,): what lies beyond them does nothing."""
        return (self._low - self._zero) / self._scale, (self._high - self._zero) / self._scale

    def approach(self, parameters: LawParameters, wanted: torch.Tensor) -> None:
        """While `active`, bring `parameters` closer to what is `wanted` (N, M), as far as a control step allows."""
        now = self._present(parameters)
        self._write(parameters, wanted.clamp(now - self._most, now + self._most))

    def reset(self, parameters: LawParameters, mask: torch.Tensor) -> None:
        """Begin with what the laws are configured with, in the envs of `mask` (N,)."""
        if self.active:
            self._write(parameters, torch.where(mask.unsqueeze(1), self._zero, self._present(parameters)))

    def _present(self, parameters: LawParameters) -> torch.Tensor:
        both = torch.cat((parameters.alpha.unsqueeze(2), parameters.stiffness.log()), 2)
        return both[..., : self._per_arm].flatten(1)

    def _write(self, parameters: LawParameters, values: torch.Tensor) -> None:
        by_arm = values.unflatten(1, (-1, self._per_arm))
        parameters.alpha = by_arm[..., 0]
        if self._per_arm > 1:
            parameters.stiffness = by_arm[..., 1:].exp()


def observed_laws(parameters: LawParameters) -> dict[str, torch.Tensor]:
    """Values (N, width) of the terms that show the laws' parameters, unscaled."""
    log_stiffness = (parameters.stiffness / OBSERVED_STIFFNESS).log()
    return {"law_alpha": parameters.alpha, "law_log_stiffness": log_stiffness.flatten(1)}
