"""What the package knows of a robot: one frozen description, everything by name, SI units."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

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
    default_rad: float
    mirror_name: str
    """The joint it becomes when the robot is reflected in its sagittal plane."""
    mirror_sign: float


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
    """A foot: the body that touches the ground, the centre of its sole, and how its leg lifts it."""

    side: str
    body: str
    sole: Vec3
    """In `body`'s frame [m]."""
    flexion: tuple[tuple[str, float], ...]
    """Joints and angles [rad], relative to the default pose, that lift the sole straight up by a step's height."""


@dataclass(frozen=True)
class StanceGain:
    """Linear feedback that balances a robot on both feet, fore and aft, at one height."""

    height_offset_m: float
    """Torso height relative to nominal."""
    gain: tuple[tuple[float, ...], ...]
    """Per joint, what its target moves by per radian of forward tilt, per radian of each joint's error (mean of all
    legs), and per rad/s of the same: 2 (1 + n) numbers."""
    bias: tuple[float, ...]
    """Per joint, what its target moves by always [rad]."""


@dataclass(frozen=True)
class StanceSpec:
    """What a robot needs to stand, for its PD gains (see `cotap.envs.stance`)."""

    joints: tuple[tuple[str, ...], ...]
    """Per leg, the joints that pitch, from the hip down."""
    gains: tuple[StanceGain, StanceGain]
    """At nominal height and at a low one."""


@dataclass(frozen=True)
class RobotSpec:
    """A floating-base robot. `joints` is in actuator order: the lower agent's first, then the upper's."""

    name: str
    bodies: tuple[BodySpec, ...]
    joints: tuple[JointSpec, ...]
    base_body: str
    torso_body: str
    arms: tuple[ArmSpec, ...]
    feet: tuple[FootSpec, ...]
    stance: StanceSpec
    joint_damping: float
    joint_armature: float
    nominal_height_m: float
    """Height of the torso link above flat ground in the default pose."""
    legs_below_m: float
    """The legs' top in the torso link's frame, as far as hands are concerned."""
    legs_within_m: float
    """How far to either side of the middle a low hand may meet them."""
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
    def lower_joints(self) -> tuple[str, ...]:
        """Every other joint: legs and waist."""
        return tuple(n for n in self.joint_names if n not in self.upper_joints)

    def __post_init__(self) -> None:
        if self.joint_names != self.lower_joints + self.upper_joints:
            raise ValueError(f"{self.name}: joints must be ordered lower body first, then the arms in order")
        for j in self.joints:
            if j.mirror_name not in self.joint_names:
                raise ValueError(f"{self.name}: mirror of {j.name} is unknown: {j.mirror_name!r}")

    def indices(self, names: tuple[str, ...] | list[str]) -> list[int]:
        """Positions of `names` among `joints`. Raises ValueError for an unknown name, listing all."""
        missing = [n for n in names if n not in self.joint_names]
        if missing:
            raise ValueError(f"{self.name} has no joint {missing[0]!r}; joints: {', '.join(self.joint_names)}")
        return [self.joint_names.index(n) for n in names]

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
