"""What the package knows of a robot: one frozen description, everything by name, SI units."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from itertools import zip_longest

import numpy as np

from cotap.checks import require_range
from cotap.robots.kinematics import body_frame, default_angles

Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]


@dataclass(frozen=True)
class GeomSpec:
    """A primitive shape in its body's frame; sizes as in MuJoCo (radii and half lengths)."""

    type: str
    size: Vec3
    pos: Vec3 = (0.0, 0.0, 0.0)
    quat: Quat = (1.0, 0.0, 0.0, 0.0)
    color: str = "dark"


@dataclass(frozen=True)
class JointSpec:
    """An actuated hinge: limits, PD gains and default angle, plus its left-right mirror image."""

    name: str
    axis: Vec3
    range_rad: tuple[float, float]
    torque_limit_nm: float
    velocity_limit_rad_s: float
    kp: float
    """Position gain [Nm/rad]."""
    kd: float
    """Damping gain [Nms/rad]."""
    armature_kg_m2: float
    """Rotor inertia as the joint feels it, gears included."""
    damping_nms_rad: float
    """Viscous friction, beside what the motor damps."""
    default_rad: float
    mirror_name: str
    """The joint it becomes when the robot is reflected in its sagittal plane."""
    mirror_sign: float
    """What its angle is multiplied by then."""


@dataclass(frozen=True)
class BodySpec:
    """A link: pose in its parent's frame, inertia in its own, shapes."""

    name: str
    parent: str
    pos: Vec3
    quat: Quat
    mass_kg: float
    com: Vec3
    inertia_quat: Quat
    diaginertia: Vec3
    joint: str | None
    """The hinge that moves it; None for the free-floating base."""
    collision: tuple[GeomSpec, ...] = ()
    visual: tuple[GeomSpec, ...] = ()


@dataclass(frozen=True)
class ArmSpec:
    """An arm from the torso link to the hand."""

    side: str
    joints: tuple[str, ...]
    hand_body: str
    hand_point: Vec3
    """The hand in `hand_body`'s frame [m]."""
    elbow_body: str
    """The body whose origin is the elbow key point."""


@dataclass(frozen=True)
class FootSpec:
    """A foot: the body that touches the ground, and the centre of its sole."""

    side: str
    body: str
    sole: Vec3
    """In `body`'s frame [m]."""


@dataclass(frozen=True)
class RobotSpec:
    """A floating-base robot.

    `joints` is in actuator order: the lower agent's first, then the upper's. It is also the order in which MuJoCo
    visits the bodies, depth first, so that `qpos[7:]` is joint by joint the same.

    Raises:
        ValueError: joints are out of order, a name is unknown, a joint's number is out of its range, mirrors or their
            defaults disagree, base and torso are one body, arms differ in length or do not lead to their hands, or arms
            and feet are not a left and a right one.
    """

    name: str
    bodies: tuple[BodySpec, ...]
    joints: tuple[JointSpec, ...]
    base_body: str
    torso_body: str
    arms: tuple[ArmSpec, ...]
    feet: tuple[FootSpec, ...]
    nominal_height_m: float
    """Height of the torso link above flat ground in the default pose."""
    contact_excludes: tuple[tuple[str, str], ...] = ()
    """Pairs of bodies that never collide."""
    menagerie: str = ""
    """The robot's name in MuJoCo Menagerie, for those who have its meshes."""
    colors: dict[str, tuple[float, float, float]] = field(default_factory=dict)

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        return tuple(j.name for j in self.joints)

    @cached_property
    def upper_joints(self) -> tuple[str, ...]:
        """The arm joints, arm by arm: what the upper agent moves."""
        return tuple(name for arm in self.arms for name in arm.joints)

    @cached_property
    def upper_joint_specs(self) -> tuple[JointSpec, ...]:
        """The same, described."""
        return self.joints[len(self.lower_joints) :]

    @cached_property
    def lower_joints(self) -> tuple[str, ...]:
        """Every other joint: legs and waist."""
        return tuple(n for n in self.joint_names if n not in self.upper_joints)

    @cached_property
    def waist_joints(self) -> tuple[str, ...]:
        """Joints between the base and the torso, from the base up."""
        return tuple(body.joint for body in self.chain(self.torso_body, self.base_body) if body.joint is not None)

    @cached_property
    def mass_kg(self) -> float:
        """Of all bodies."""
        return sum(b.mass_kg for b in self.bodies)

    @cached_property
    def base_height_m(self) -> float:
        """Height of the base above flat ground in the default pose, the base level."""
        torso, _ = body_frame(self, self.torso_body, self.base_body, default_angles(self))
        return self.nominal_height_m - float(torso[2])

    @cached_property
    def sole_distance_m(self) -> float:
        """Lateral distance between the first two soles in the default pose."""
        first, second = (self.sole(foot) for foot in self.feet[:2])
        return abs(float(first[1] - second[1]))

    def pitches(self, joint: str) -> bool:
        """Whether a joint's axis lies along the base's y axis in the default pose, rather than along x or z."""
        body = next(b.name for b in self.bodies if b.joint == joint)
        _, rotation = body_frame(self, body, self.base_body, default_angles(self))
        return abs(float((rotation @ self.joint(joint).axis)[1])) > 0.7

    @cached_property
    def torso_ahead_m(self) -> float:
        """How far ahead of the middle of the soles the torso link's origin is in the default pose."""
        torso, _ = body_frame(self, self.torso_body, self.base_body, default_angles(self))
        return float(torso[0] - sum(self.sole(foot)[0] for foot in self.feet) / len(self.feet))

    def __post_init__(self) -> None:
        self._check_sides()
        for joint in self.joints:
            self._check_numbers(joint)
        self._check_order()
        self._check_mirrors()
        self._check_bodies()
        self._check_arms()

    def indices(self, names: tuple[str, ...] | list[str]) -> list[int]:
        """Positions of `names` among `joints`. Raises ValueError for an unknown name, listing all."""
        missing = [n for n in names if n not in self.joint_names]
        if missing:
            raise ValueError(f"{self.name} has no joint {missing[0]!r}; joints: {', '.join(self.joint_names)}")
        return [self.joint_names.index(n) for n in names]

    def joint(self, name: str) -> JointSpec:
        """The joint called `name`. Raises ValueError listing all joints."""
        return self.joints[self.indices([name])[0]]

    def body(self, name: str) -> BodySpec:
        """The body called `name`. Raises ValueError listing all bodies."""
        for b in self.bodies:
            if b.name == name:
                return b
        raise ValueError(f"{self.name} has no body {name!r}; bodies: {', '.join(b.name for b in self.bodies)}")

    def chain(self, tip: str, root: str) -> tuple[BodySpec, ...]:
        """Bodies from below `root` to `tip`, in order."""
        out: list[BodySpec] = []
        body = self.body(tip)
        while body.name != root:
            out.append(body)
            if body.parent == "world":
                raise ValueError(f"{self.name}: {tip!r} is not below {root!r}")
            body = self.body(body.parent)
        return tuple(reversed(out))

    def sole(self, foot: FootSpec) -> np.ndarray:
        """Centre of a sole (3,) in the base's frame in the default pose [m]."""
        position, rotation = body_frame(self, foot.body, self.base_body, default_angles(self))
        return position + rotation @ foot.sole

    def _check_sides(self) -> None:
        for what, parts in (("arms", self.arms), ("feet", self.feet)):
            sides = tuple(part.side for part in parts)
            if sides != ("left", "right"):
                raise ValueError(f"{self.name}: {what} must be 'left' and 'right', in this order, got {sides}")

    def _check_numbers(self, j: JointSpec) -> None:
        where, most = f"{self.name}: joint {j.name!r}", 1e9
        for name in ("torque_limit_nm", "velocity_limit_rad_s"):
            require_range(f"{where}: {name}", getattr(j, name), 1e-6, most)
        for name in ("kp", "kd", "armature_kg_m2", "damping_nms_rad"):
            require_range(f"{where}: {name}", getattr(j, name), 0.0, most)
        low, high = (require_range(f"{where}: range_rad", bound, -most, most) for bound in j.range_rad)
        if not low < high:
            raise ValueError(f"{where}: range_rad must begin below its end, got {j.range_rad}")
        require_range(f"{where}: default_rad", j.default_rad, low, high)

    def _check_arms(self) -> None:
        lengths = {arm.side: len(arm.joints) for arm in self.arms}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"{self.name}: arms must have equally many joints, got {lengths}")
        for arm in self.arms:
            joints = tuple(body.joint for body in self.chain(arm.hand_body, self.torso_body))
            if joints != arm.joints:
                raise ValueError(
                    f"{self.name}: the {arm.side} arm's joints must be those from the torso to its hand, {joints}, got "
                    f"{arm.joints}"
                )

    def _check_order(self) -> None:
        if self.joint_names != self.lower_joints + self.upper_joints:
            raise ValueError(f"{self.name}: joints must be ordered lower body first, then the arms in order")
        visited = [b.joint for b in self._depth_first("world") if b.joint is not None]
        for have, want in zip_longest(self.joint_names, visited):
            if have != want:
                raise ValueError(
                    f"{self.name}: joint {have!r} is out of order, {want!r} is next: joints must follow the bodies, "
                    "depth first"
                )

    def _depth_first(self, parent: str) -> list[BodySpec]:
        """Bodies below `parent` as MuJoCo visits them."""
        children = [b for b in self.bodies if b.parent == parent]
        return [body for child in children for body in (child, *self._depth_first(child.name))]

    def _check_mirrors(self) -> None:
        for j in self.joints:
            if j.mirror_name not in self.joint_names:
                raise ValueError(f"{self.name}: mirror of {j.name} is unknown: {j.mirror_name!r}")
            mirror = self.joint(j.mirror_name)
            if j.mirror_sign not in (1.0, -1.0):
                raise ValueError(f"{self.name}: mirror_sign of {j.name} must be 1 or -1, got {j.mirror_sign!r}")
            if (mirror.mirror_name, mirror.mirror_sign) != (j.name, j.mirror_sign):
                raise ValueError(f"{self.name}: {j.name} and {mirror.name} are not each other's mirror with one sign")
            if j.default_rad != j.mirror_sign * mirror.default_rad:
                raise ValueError(
                    f"{self.name}: the default pose must be its own mirror image; {j.name} has {j.default_rad:g} rad "
                    f"and {mirror.name} {mirror.default_rad:g} rad, with sign {j.mirror_sign:g}"
                )

    def _check_bodies(self) -> None:
        if self.base_body == self.torso_body:
            raise ValueError(f"{self.name}: base and torso must be two bodies, got {self.base_body!r} for both")
        ends = [body for arm in self.arms for body in (arm.hand_body, arm.elbow_body)] + [f.body for f in self.feet]
        for name in (self.base_body, self.torso_body, *ends, *(n for pair in self.contact_excludes for n in pair)):
            self.body(name)
        if self.sole(self.feet[0])[1] <= self.sole(self.feet[1])[1]:
            raise ValueError(f"{self.name}: the left foot must come first, got {self.feet[0].side!r}")
