"""Rotor inertia for engines that know only links."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from cotap.robots import BodySpec, RobotSpec
from cotap.robots.kinematics import body_frame
from cotap.robots.urdf import rotation


def with_rotors(spec: RobotSpec) -> RobotSpec:
    """The robot with its rotors' inertia (`armature_kg_m2`) made part of links, and none left at the joints.

    A rotor resists the motion of its joint alone, a link's inertia resists all rotation of the link: this is an
    approximation, which keeps the diagonal of the joint-space inertia at zero angles.
    """
    amounts = rotor_inertias(spec)
    bodies = tuple(_with_rotor(spec, body, amounts.get(body.name, 0.0)) for body in spec.bodies)
    joints = tuple(dataclasses.replace(joint, armature_kg_m2=0.0) for joint in spec.joints)
    return dataclasses.replace(spec, bodies=bodies, joints=joints)


def rotor_inertias(spec: RobotSpec) -> dict[str, float]:
    """Inertia about its joint's axis that each moved body gets [kg m^2].

    What bodies further out have been given already resists a joint as far as their axes are its own: the rest, from
    the tips inwards, is what its body still needs.
    """
    hinges = {body.name: spec.joint(body.joint) for body in spec.bodies if body.joint}
    zero = np.zeros(len(spec.joints))
    axes = {name: body_frame(spec, name, spec.base_body, zero)[1] @ hinge.axis for name, hinge in hinges.items()}
    out: dict[str, float] = {}
    for name in reversed(list(axes)):
        below = [b for b in axes if b != name and name in _ancestors(spec, b)]
        felt = sum(out[b] * float(axes[name] @ axes[b]) ** 2 for b in below)
        out[name] = max(0.0, hinges[name].armature_kg_m2 - felt)
    return out


def _with_rotor(spec: RobotSpec, body: BodySpec, amount: float) -> BodySpec:
    if amount == 0.0:
        return body
    axis = np.array(spec.joint(body.joint or "").axis)
    frame = rotation(body.inertia_quat).as_matrix()
    tensor = frame @ np.diag(body.diaginertia) @ frame.T + amount * np.outer(axis, axis)
    moments, directions = np.linalg.eigh(tensor)
    directions[:, 0] *= np.sign(np.linalg.det(directions))
    quat = Rotation.from_matrix(directions).as_quat(scalar_first=True)
    return dataclasses.replace(body, diaginertia=tuple(moments.tolist()), inertia_quat=tuple(quat.tolist()))


def _ancestors(spec: RobotSpec, name: str) -> set[str]:
    return {body.name for body in spec.chain(name, spec.base_body)} - {name}
