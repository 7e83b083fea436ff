"""Task-space stiffness in, symmetric positive definite joint stiffness out; pure torch, usable without a simulator."""

from cotap.compliance.arm_kinematics import ArmKinematics
from cotap.compliance.spd import log_euclidean_mean, modulate_stiffness, spd_exp, spd_log
from cotap.compliance.stiffness import condition_number, resolve_joint_stiffness, singularity_aware_ratio

__all__ = [
    "ArmKinematics",
    "condition_number",
    "log_euclidean_mean",
    "modulate_stiffness",
    "resolve_joint_stiffness",
    "singularity_aware_ratio",
    "spd_exp",
    "spd_log",
]
