"""RobotSpec to URDF, for engines and tools that read nothing else."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from xml.etree import ElementTree as ET

import numpy as np
from scipy.spatial.transform import Rotation

from cotap.robots.spec import BodySpec, GeomSpec, Quat, RobotSpec


def urdf(spec: RobotSpec) -> str:
    """The robot as URDF: links, inertias, hinges with limits and damping, collision shapes.

    A capsule, which URDF does not know, is a cylinder with a sphere at either end. Rotor inertia, which URDF does not
    know either, is left out.

    Raises:
        ValueError: a body has a collision shape that URDF cannot express.
    """
    root = ET.Element("robot", name=spec.name)
    for body in spec.bodies:
        _add_link(root, body)
        if body.joint is not None:
            _add_joint(root, body, spec)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def rotation(quat: Quat) -> Rotation:
    """The rotation of a quaternion (w, x, y, z)."""
    return Rotation.from_quat(quat, scalar_first=True)


def _numbers(values: Iterable[float]) -> str:
    return " ".join(f"{float(v):.10g}" for v in values)


def _origin(parent: ET.Element, position: Iterable[float], orientation: Rotation) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # at a pitch of 90 degrees many angles mean the same
        angles = orientation.as_euler("xyz")  # lower case: about fixed axes, as URDF has roll, pitch and yaw
    ET.SubElement(parent, "origin", xyz=_numbers(position), rpy=_numbers(angles))


def _add_link(root: ET.Element, body: BodySpec) -> None:
    link = ET.SubElement(root, "link", name=body.name)
    inertial = ET.SubElement(link, "inertial")
    _origin(inertial, body.com, rotation(body.inertia_quat))
    ET.SubElement(inertial, "mass", value=_numbers([body.mass_kg]))
    ixx, iyy, izz = (_numbers([v]) for v in body.diaginertia)
    ET.SubElement(inertial, "inertia", ixx=ixx, iyy=iyy, izz=izz, ixy="0", ixz="0", iyz="0")
    for geom in body.collision:
        for shape, attributes, offset in _shapes(body, geom):
            collision = ET.SubElement(link, "collision")
            orientation = rotation(geom.quat)
            _origin(collision, np.array(geom.pos) + orientation.apply([0.0, 0.0, offset]), orientation)
            ET.SubElement(ET.SubElement(collision, "geometry"), shape, attributes)


def _shapes(body: BodySpec, geom: GeomSpec) -> list[tuple[str, dict[str, str], float]]:
    """URDF shapes, their attributes, and how far along the geom's z axis each lies [m]."""
    radius, half = geom.size[0], geom.size[1]
    ball = ("sphere", {"radius": _numbers([radius])})
    rod = ("cylinder", {"radius": _numbers([radius]), "length": _numbers([2.0 * half])})
    if geom.type == "sphere":
        return [(*ball, 0.0)]
    if geom.type == "cylinder":
        return [(*rod, 0.0)]
    if geom.type == "capsule":
        return [(*rod, 0.0), (*ball, half), (*ball, -half)]
    if geom.type == "box":
        return [("box", {"size": _numbers(2.0 * np.array(geom.size))}, 0.0)]
    raise ValueError(f"body {body.name!r} has a collision shape {geom.type!r}, which URDF cannot express")


def _add_joint(root: ET.Element, body: BodySpec, spec: RobotSpec) -> None:
    hinge = spec.joint(body.joint or "")
    joint = ET.SubElement(root, "joint", name=hinge.name, type="revolute")
    ET.SubElement(joint, "parent", link=body.parent)
    ET.SubElement(joint, "child", link=body.name)
    _origin(joint, body.pos, rotation(body.quat))
    ET.SubElement(joint, "axis", xyz=_numbers(hinge.axis))
    (low, high), limits = hinge.range_rad, (hinge.torque_limit_nm, hinge.velocity_limit_rad_s)
    lower, upper, effort, velocity = (_numbers([v]) for v in (low, high, *limits))
    ET.SubElement(joint, "limit", lower=lower, upper=upper, effort=effort, velocity=velocity)
    ET.SubElement(joint, "dynamics", damping=_numbers([hinge.damping_nms_rad]), friction="0")
