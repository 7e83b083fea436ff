"""Task-space stiffness in, symmetric positive definite joint stiffness out; pure torch, usable without a simulator."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cotap.compliance.arm_kinematics import ArmKinematics
    from cotap.compliance.passivity import EnergyStore, damping_energy, hold_back, rate_margin, stiffness_energy
    from cotap.compliance.spd import log_euclidean_mean, modulate_stiffness, spd_exp, spd_log
    from cotap.compliance.stiffness import condition_number, resolve_joint_stiffness, singularity_aware_ratio

__all__ = [
    "ArmKinematics",
    "EnergyStore",
    "condition_number",
    "damping_energy",
    "hold_back",
    "log_euclidean_mean",
    "modulate_stiffness",
    "rate_margin",
    "resolve_joint_stiffness",
    "singularity_aware_ratio",
    "spd_exp",
    "spd_log",
    "stiffness_energy",
]
_MODULES = {
    "arm_kinematics": ("ArmKinematics",),
    "passivity": ("EnergyStore", "damping_energy", "hold_back", "rate_margin", "stiffness_energy"),
    "spd": ("log_euclidean_mean", "modulate_stiffness", "spd_exp", "spd_log"),
    "stiffness": ("condition_number", "resolve_joint_stiffness", "singularity_aware_ratio"),
}


def __getattr__(name: str) -> Any:
    """Load what is asked for: the logarithm brings torch's compiler, which a simulation does not need."""
    for module, names in _MODULES.items():
        if name in names:
            return getattr(importlib.import_module(f"cotap.compliance.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
