"""Which law drives which arm, from the command line."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

from cotap.checks import quoted, require_one_of, require_range
from cotap.compliance.laws import LAWS, READS, LawConfig, reads
from cotap.envs.upper_body import LawSampling, UpperBodyConfig

SIDES = ("left", "right")
OF_ALL_ARMS = {"torso_compliance": "condition_threshold", "singularity_ratio": "condition_threshold"}
"""Options of both arms at once, each with the field of `LawConfig` by which it is decided which laws read it."""


@dataclass
class LawOptions:
    """Laws of the arms. What is not given is as the policy was trained, under another law too. A policy that was
    trained under PD has the protocol's own law, if it has one. A policy that sets alpha and stiffness
    itself no longer does once a method, a law, alpha or stiffness is given."""

    method: str | None = None
    """Law of both arms: pd, soft-pd, cotap, facet, cotap+facet, cotap+facet-matched, hmc or dcc."""
    stiffness: tuple[float, ...] | None = None
    """Hand stiffness, one number or X Y Z, heading frame [N/m]."""
    null_stiffness: float | None = None
    """Stiffness of arm motion that leaves the hand where it is [Nm/rad]."""
    alpha: float | None = None
    """Share of compliance in the blend with PD, 0 to 1 (cotap, hmc). cotap blends stiffness, hmc torque."""
    error: str | None = None
    """What stiffness acts on: joint, or task (the error of the hand)."""
    damping: str | None = None
    """Damping of the arm: pd or critical."""
    sensing: str | None = None
    """Force on the hand: privileged or estimated, from arm torques (facet, dcc)."""
    passive: bool = False
    """Hold back changes of stiffness that would give away more energy than a store has (cotap). By default as in
    the training."""
    torso_compliance: str | None = None
    """Model of how far the torso yields: none, constant or support. The arm provides the rest of the compliance."""
    left: str = ""
    """A law for the left arm alone, such as cotap:alpha=0.7,stiffness=500."""
    right: str = ""
    """A law for the right arm alone."""
    singularity_ratio: bool | None = None
    """Whether to go back to PD near singular arms (paper, equation 10)."""

    def configure(self, trained: UpperBodyConfig | None = None) -> UpperBodyConfig:
        """The config of the arms, for a policy that was trained with `trained`.

        Raises:
            ValueError: an option is out of its range, or neither arm's law reads it.
        """
        out = copy.deepcopy(trained or UpperBodyConfig())
        out.left, out.right = (self._law(side, out.of(side)) for side in SIDES)
        out.sampling = LawSampling()
        if self.torso_compliance is not None:
            out.torso.model = self.torso_compliance
        if self.singularity_ratio is not None:
            out.singularity_ratio = self.singularity_ratio
        if self._fixes_laws():
            out.modulation.hold()
        out.check()
        self._require_read({side: out.of(side).name for side in SIDES})
        return out

    def given(self) -> list[str]:
        """Names of the options that were given, `left` and `right` aside."""
        return [f.name for f in fields(self) if f.name not in SIDES and getattr(self, f.name) != f.default]

    def _fixes_laws(self) -> bool:
        """Whether what a policy could set of the laws is given."""
        return any(getattr(self, name) not in (None, "") for name in ("method", "stiffness", "alpha", *SIDES))

    def require_free(self, driven: Mapping[str, str]) -> None:
        """Raise ValueError if a field of laws is given that a protocol sets itself, by the option in `driven`."""
        for name, option in driven.items():
            if name in (*self.given(), *_assigned(self.left), *_assigned(self.right)):
                raise ValueError(f"{_flag(name)} does nothing here: the protocol sets it, see {option}")

    def _require_read(self, laws: dict[str, str]) -> None:
        """Raise ValueError for the first option that does nothing under these laws, by side."""
        if self.method is not None and self.left and self.right:
            raise ValueError("--method does nothing beside --left and --right: they name both arms' laws")
        for name in self.given():
            field = OF_ALL_ARMS.get(name, name)
            readers = [side for side, law in laws.items() if reads(law, field)]
            if name == "method" or any(name not in _assigned(getattr(self, side)) for side in readers):
                continue
            if readers:
                raise ValueError(f"{_flag(name)} does nothing: --left and --right give it themselves")
            named, known = " and ".join(sorted(set(laws.values()))), [law for law in READS if reads(law, field)]
            raise ValueError(
                f"{_flag(name)} is not read by {named}, the law here; laws that read it: {', '.join(known)}. Take one "
                "with --method"
            )

    def _law(self, side: str, trained: LawConfig) -> LawConfig:
        name, text = self.method or trained.name, getattr(self, side)
        given = {f.name: getattr(self, f.name) for f in fields(LawConfig) if f.name in self.given()}
        if self.stiffness is not None:
            given["stiffness"] = _three(self.stiffness)
        law = replace(trained, name=name, **given)
        return parse_law(side, text, law) if text else _without_unread_store(law)


def parse_law(option: str, text: str, common: LawConfig) -> LawConfig:
    """`NAME:field=value,...` on top of `common`; several numbers are joined by `x`, as in stiffness=500x500x300.

    Raises:
        ValueError: a law, a field or a number is not known, or the law does not read the field; the message names it.
    """
    name, _, rest = text.partition(":")
    law = replace(common, name=require_one_of(f"--{option}", name, LAWS.keys()))
    known = {f.name: f.type for f in fields(LawConfig) if f.name != "name"}
    for part in filter(None, rest.split(",")):
        _, equals, value = part.partition("=")
        key = _key(part)
        require_one_of(f"--{option} field", key, known.keys())
        if not reads(name, key):
            raise ValueError(f"--{option}: {name} does not read {key}; it reads: {', '.join(READS[name]) or 'nothing'}")
        if not equals:
            raise ValueError(f"--{option}: {key} needs a value, as in {key}=...")
        if known[key] == "str":
            law = replace(law, **{key: value})
            continue
        if known[key] == "bool":
            law = replace(law, **{key: require_one_of(f"--{option}: {key}", value, ("true", "false")) == "true"})
            continue
        try:
            numbers = tuple(float(v) for v in value.split("x"))
        except ValueError as error:
            raise ValueError(f"--{option}: {key} must be a number, got {quoted(value)}") from error
        law = replace(law, **{key: _three(numbers) if key == "stiffness" else _one(option, key, numbers)})
    return _without_unread_store(law)


def make_passive(arms: UpperBodyConfig) -> None:
    """Give an energy store to every arm whose law can have one. Raises ValueError if none can."""
    able = [law for law in (arms.left, arms.right) if reads(law.name, "passive")]
    if not able:
        raise ValueError(f"--passive is not read by {' and '.join({arms.left.name, arms.right.name})}, the law here")
    for law in able:
        law.passive = True


def _without_unread_store(law: LawConfig) -> LawConfig:
    """`law` without the energy store that it was to have in common with another arm's, if it can have none."""
    return law if reads(law.name, "passive") else replace(law, passive=False)


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _key(part: str) -> str:
    """The field that `field=value` is about."""
    return part.partition("=")[0].strip().replace("-", "_")


def _assigned(text: str) -> set[str]:
    """The fields that a law's text gives."""
    return {_key(part) for part in text.partition(":")[2].split(",")}


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
