"""Which law drives which arm, from the command line."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

from cotap.checks import require_one_of, require_range
from cotap.compliance.laws import LAWS, LawConfig
from cotap.envs.upper_body import UpperBodyConfig


@dataclass
class LawOptions:
    """Laws of the arms."""

    method: str = "pd"
    """Upper-body law of both arms: pd, soft-pd, cotap, facet, cotap+facet, cotap+facet-matched, hmc or dcc."""
    stiffness: tuple[float, ...] = (300.0,)
    """Hand stiffness, one number or X Y Z, heading frame [N/m]."""
    null_stiffness: float = 25.0
    """Stiffness of arm motion that leaves the hand where it is [Nm/rad]."""
    alpha: float = LawConfig.alpha
    """Share of compliance in its blend with PD (cotap, hmc)."""
    error: str = LawConfig.error
    """What stiffness acts on: joint or task error."""
    damping: str = LawConfig.damping
    """pd or critical."""
    virtual_mass: float = LawConfig.virtual_mass
    """Mass of the hand's model [kg] (facet, hmc)."""
    damping_ratio: float = LawConfig.damping_ratio
    """Damping of the hand's model, as a share of critical (facet, hmc)."""
    sensing: str = LawConfig.sensing
    """Force on the hand: privileged or estimated, from arm torques (facet, dcc)."""
    reference_share: float = LawConfig.reference_share
    """Share of the compliance that the moving reference provides (cotap+facet-matched)."""
    torso_compliance: str = "none"
    """What is put down to the torso: none, constant or support."""
    left: str = ""
    """A law for the left arm alone, such as cotap:alpha=0.7,stiffness=500."""
    right: str = ""
    """A law for the right arm alone."""
    singularity_ratio: bool = True
    """Go back to PD near singular arms (paper, equation 9). Without it, for the ablation that was trained so."""

    def configure(self) -> UpperBodyConfig:
        """The config of the arms. Raises ValueError naming what is wrong."""
        own: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(LawConfig) if hasattr(self, f.name)}
        own["stiffness"] = _three(self.stiffness)
        common = LawConfig(self.method, **own)
        out = UpperBodyConfig(
            parse_law("left", self.left, common) if self.left else common,
            parse_law("right", self.right, common) if self.right else replace(common),
        )
        out.torso.model, out.singularity_ratio = self.torso_compliance, self.singularity_ratio
        out.check()
        return out


def parse_law(option: str, text: str, common: LawConfig) -> LawConfig:
    """`NAME:field=value,...` on top of `common`; several numbers are joined by `x`, as in stiffness=500x500x300.

    Raises:
        ValueError: a law, a field or a number is not known; the message names it.
    """
    name, _, rest = text.partition(":")
    law = replace(common, name=require_one_of(f"--{option}", name, LAWS.keys()))
    known = {f.name: f.type for f in fields(LawConfig) if f.name != "name"}
    for part in filter(None, rest.split(",")):
        key, equals, value = part.partition("=")
        key = key.strip().replace("-", "_")
        require_one_of(f"--{option} field", key, known.keys())
        if not equals:
            raise ValueError(f"--{option}: {key} needs a value, as in {key}=...")
        if known[key] == "str":
            law = replace(law, **{key: value})
            continue
        try:
            numbers = tuple(float(v) for v in value.split("x"))
        except ValueError as error:
            raise ValueError(f"--{option}: {key} must be a number, got {value!r}") from error
        law = replace(law, **{key: _three(numbers) if key == "stiffness" else _one(option, key, numbers)})
    return law


def _one(option: str, key: str, numbers: tuple[float, ...]) -> float:
    if len(numbers) != 1:
        raise ValueError(f"--{option}: {key} must be one number, got {len(numbers)}")
    return numbers[0]


def _three(numbers: tuple[float, ...]) -> tuple[float, float, float]:
    if len(numbers) not in (1, 3):
        raise ValueError(f"stiffness must be one number or three (X Y Z), got {len(numbers)}")
    for i, value in enumerate(numbers):
        require_range(f"stiffness[{i}]", value, 1.0, 1e5)
    x, y, z = numbers * 3 if len(numbers) == 1 else numbers
    return x, y, z
