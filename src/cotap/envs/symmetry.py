"""Left-right reflection of observations and actions, as signed permutations."""

from __future__ import annotations

import torch

from cotap.envs.observations import Term
from cotap.reflection import Reflection, join
from cotap.robots import RobotSpec

# Reflection in the x-z plane: vectors keep x and z, axial vectors (rotations) keep y.
_VECTOR, _AXIAL = (1.0, -1.0, 1.0), (-1.0, 1.0, -1.0)
_SIGNS: dict[str, tuple[float, ...]] = {
    "torso_angular_velocity": _AXIAL,
    "projected_gravity": _VECTOR,
    "command_velocity": (1.0, -1.0),
    "command_yaw_rate": (-1.0,),
    "command_stand": (1.0,),
    "command_height": (1.0,),
    # Half a stride later; both are zero while standing.
    "sin_phase": (-1.0,),
    "cos_phase": (-1.0,),
    "torso_orientation": (1.0, *_AXIAL),
    "torso_linear_velocity": _VECTOR,
    "mean_error": (1.0, -1.0, -1.0),
    "torso_height": (1.0,),
    "push_nearness": (1.0,),
    "push_velocity": _VECTOR,
    "load_nearness": (1.0,),
}


def joint_reflection(spec: RobotSpec, joints: tuple[str, ...]) -> Reflection:
    """Reflection of a vector over `joints`, which must contain every joint's mirror image."""
    by_name = {j.name: j for j in spec.joints}
    return Reflection(
        torch.tensor([joints.index(by_name[n].mirror_name) for n in joints]),
        torch.tensor([by_name[n].mirror_sign for n in joints]),
    )


def _term_reflection(spec: RobotSpec, name: str, width: int) -> Reflection:
    if name in ("joint_position", "joint_velocity", "last_action"):
        return joint_reflection(spec, spec.joint_names)
    if name in ("reference_arm_position", "arm_torque"):
        return joint_reflection(spec, spec.upper_joints)
    if name in ("foot_contact", "foot_height"):
        return Reflection(_swapped([foot.side for foot in spec.feet]), torch.ones(width))
    if name in ("hand_force", "coming_load"):
        hands = 3 * _swapped([arm.side for arm in spec.arms]).unsqueeze(1) + torch.arange(3)
        return Reflection(hands.flatten(), torch.tensor(_VECTOR * len(spec.arms)))
    if name == "push_place":  # the base, each hand, a link
        hands = 1 + _swapped([arm.side for arm in spec.arms])
        return Reflection(torch.cat((torch.tensor([0]), hands, torch.tensor([width - 1]))), torch.ones(width))
    if name in ("goals", "law_alpha", "law_log_stiffness"):
        return law_reflection(spec, width)
    return Reflection(torch.arange(width), torch.tensor(_SIGNS[name]))


def law_reflection(spec: RobotSpec, width: int) -> Reflection:
    """Reflection of laws' parameters, arm by arm: diagonal stiffness is its own mirror image; arms change places."""
    arms = torch.arange(width).reshape(len(spec.arms), width // len(spec.arms))
    return Reflection(arms[_swapped([arm.side for arm in spec.arms])].flatten(), torch.ones(width))


def _swapped(sides: list[str]) -> torch.Tensor:
    """Which arm or foot each of them becomes."""
    swap = {"left": "right", "right": "left"}
    return torch.tensor([sides.index(swap[s]) for s in sides])


def actor_reflection(spec: RobotSpec, terms: tuple[Term, ...], history: int) -> Reflection:
    """Of the actor's observation: `history` steps of every term, term by term."""
    return join([_term_reflection(spec, name, width) for name, width, _ in terms for _ in range(history)])


def critic_reflection(spec: RobotSpec, terms: tuple[Term, ...]) -> Reflection:
    """Of what only the critic sees."""
    return join([_term_reflection(spec, name, width) for name, width, _ in terms])
