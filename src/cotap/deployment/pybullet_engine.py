"""PyBullet: an engine of other authorship, fed with the URDF that cotap writes."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from cotap.compliance.dynamics import GRAVITY_M_S2
from cotap.deployment.engines import EngineConfig, PointForce
from cotap.deployment.joint_law import JointLaw
from cotap.deployment.rotors import with_rotors
from cotap.robots import RobotSpec
from cotap.robots.urdf import urdf


class PybulletEngine:
    """One robot in PyBullet, behind MuJoCo's conventions.

    Raises:
        ModuleNotFoundError: pybullet is not installed.
    """

    def __init__(self, cfg: EngineConfig, spec: RobotSpec) -> None:
        try:
            import pybullet
            from pybullet_utils.bullet_client import BulletClient
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(
                "the engine pybullet is not installed; in cotap's folder, pip install -e '.[pybullet]'"
            ) from error
        self._model, self._pybullet = with_rotors(spec), pybullet
        self._limit = cfg.torque_limit_scale * np.array([j.torque_limit_nm for j in spec.joints])
        self._bullet = bullet = BulletClient(pybullet.DIRECT)
        bullet.setGravity(0.0, 0.0, -GRAVITY_M_S2)
        bullet.setPhysicsEngineParameter(
            fixedTimeStep=cfg.timestep, numSubSteps=0, numSolverIterations=50, deterministicOverlappingPairs=1
        )
        floor = bullet.createMultiBody(0.0, bullet.createCollisionShape(pybullet.GEOM_PLANE))
        bullet.changeDynamics(floor, -1, lateralFriction=1.0)
        self._robot, self._floor = self._load(), floor
        links = {bullet.getJointInfo(self._robot, i)[12].decode(): i for i in range(bullet.getNumJoints(self._robot))}
        by_joint = {b.joint: links[b.name] for b in spec.bodies if b.joint}
        self._joints = [by_joint[name] for name in spec.joint_names]
        self._links = {spec.base_body: -1, **links}
        for first, second in spec.contact_excludes:
            bullet.setCollisionFilterPair(self._robot, self._robot, self._links[first], self._links[second], 0)
        self._set_dynamics(cfg)
        bullet.setJointMotorControlArray(
            self._robot, self._joints, pybullet.VELOCITY_CONTROL, forces=[0.0] * len(self._joints)
        )
        base = bullet.getDynamicsInfo(self._robot, -1)
        self._com = np.array(base[3])
        self._com_rotation = Rotation.from_quat(base[4])
        self.qpos, self.qvel = np.zeros(7 + len(self._joints)), np.zeros(6 + len(self._joints))
        kinds = {"touch": 1, "pos": 3, "vel": 3, "up": 3, "forward": 3}
        self._sensors = {f"{f.side}_foot_{k}": np.zeros(n) for f in spec.feet for k, n in kinds.items()}
        self._held: int | None = None

    def sensor(self, name: str) -> np.ndarray:
        """As `Engine.sensor`."""
        return self._sensors[name]

    def reset(self, qpos: np.ndarray, qvel: np.ndarray, mass_scale: float) -> None:
        """As `Engine.reset`."""
        self.hold(False)
        self._scale_masses(mass_scale)
        base = Rotation.from_quat(qpos[3:7], scalar_first=True)
        angular_w, lever = base.apply(qvel[3:6]), base.apply(self._com)
        attitude = (base * self._com_rotation).as_quat()
        self._bullet.resetBasePositionAndOrientation(self._robot, qpos[:3] + lever, attitude)
        self._bullet.resetBaseVelocity(self._robot, qvel[:3] + np.cross(angular_w, lever), angular_w)
        for link, q, dq in zip(self._joints, qpos[7:], qvel[6:], strict=True):
            self._bullet.resetJointState(self._robot, link, q, dq)
        self._read_joints()
        self._read_base()
        self._read_feet()

    def hold(self, held: bool) -> None:
        """As `Engine.hold`."""
        if self._held is not None:
            self._bullet.removeConstraint(self._held)
            self._held = None
        if held:
            position, attitude = self._bullet.getBasePositionAndOrientation(self._robot)
            self._held = self._bullet.createConstraint(
                self._robot, -1, -1, -1, self._pybullet.JOINT_FIXED, [0.0] * 3, [0.0] * 3, position,
                childFrameOrientation=attitude,
            )  # fmt: skip
            self._bullet.changeConstraint(self._held, maxForce=1e5)

    def advance(self, law: JointLaw, steps: int, forces: Sequence[PointForce]) -> None:
        """As `Engine.advance`."""
        q, dq = self.qpos[7:], self.qvel[6:]
        for _ in range(steps):
            torque = np.clip(law.torque(q, dq), -self._limit, self._limit)
            self._bullet.setJointMotorControlArray(
                self._robot, self._joints, self._pybullet.TORQUE_CONTROL, forces=torque.tolist()
            )
            for force in forces:
                self._push(force)
            self._bullet.stepSimulation()
            self._read_joints()
        self._read_base()
        self._read_feet()

    def touching(self) -> set[tuple[str, str]]:
        """As `Engine.touching`."""
        names = {link: name for name, link in self._links.items()}
        # Bullet also lists shapes that are only near each other.
        touching = [c for c in self._bullet.getContactPoints(self._robot, self._robot) if c[8] <= 0.0]
        pairs = (sorted((names[c[3]], names[c[4]])) for c in touching)
        return {(first, second) for first, second in pairs}

    def close(self) -> None:
        """As `Engine.close`."""
        self._bullet.disconnect()

    def _load(self) -> int:
        flags = (
            self._pybullet.URDF_USE_INERTIA_FROM_FILE
            | self._pybullet.URDF_USE_SELF_COLLISION
            | self._pybullet.URDF_USE_SELF_COLLISION_EXCLUDE_PARENT
        )
        # The importer drops inertias that no rigid body could have, as a link with a rotor does: it gets spheres'.
        spheres = tuple(dataclasses.replace(b, diaginertia=(max(b.diaginertia),) * 3) for b in self._model.bodies)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"{self._model.name}.urdf"
            path.write_text(urdf(dataclasses.replace(self._model, bodies=spheres)), encoding="utf-8")
            return self._bullet.loadURDF(str(path), [0.0, 0.0, 2.0], flags=flags)

    def _set_dynamics(self, cfg: EngineConfig) -> None:
        feet = {foot.body for foot in self._model.feet}
        damping = {b.name: self._model.joint(b.joint).damping_nms_rad for b in self._model.bodies if b.joint}
        for name, link in self._links.items():
            self._bullet.changeDynamics(
                self._robot, link, linearDamping=0.0, angularDamping=0.0, jointDamping=damping.get(name, 0.0),
                lateralFriction=cfg.friction if name in feet else 1.0, rollingFriction=0.0, spinningFriction=0.0,
                restitution=0.0, maxJointVelocity=1e3,
            )  # fmt: skip

    def _scale_masses(self, scale: float) -> None:
        for body in self._model.bodies:
            self._bullet.changeDynamics(
                self._robot, self._links[body.name], mass=scale * body.mass_kg,
                localInertiaDiagonal=[scale * v for v in body.diaginertia],
            )  # fmt: skip

    def _push(self, force: PointForce) -> None:
        position, attitude = self._link_frame(force.body)
        point = position + attitude.apply(force.point)
        self._bullet.applyExternalForce(
            self._robot, self._links[force.body], force.force_w.tolist(), point.tolist(), self._pybullet.WORLD_FRAME
        )

    def _link_frame(self, body: str) -> tuple[np.ndarray, Rotation]:
        """Where a body's own frame is, (3,) [m], and its orientation."""
        state = self._bullet.getLinkState(self._robot, self._links[body], computeForwardKinematics=1)
        return np.array(state[4]), Rotation.from_quat(state[5])

    def _read_base(self) -> None:
        position, attitude = self._bullet.getBasePositionAndOrientation(self._robot)
        linear, angular = (np.array(v) for v in self._bullet.getBaseVelocity(self._robot))
        base = Rotation.from_quat(attitude) * self._com_rotation.inv()
        lever = base.apply(self._com)
        self.qpos[:3], self.qpos[3:7] = position - lever, base.as_quat(scalar_first=True)
        self.qvel[:3], self.qvel[3:6] = linear - np.cross(angular, lever), base.inv().apply(angular)

    def _read_joints(self) -> None:
        states = self._bullet.getJointStates(self._robot, self._joints)
        self.qpos[7:], self.qvel[6:] = [s[0] for s in states], [s[1] for s in states]

    def _read_feet(self) -> None:
        for foot in self._model.feet:
            link = self._links[foot.body]
            position, attitude = self._link_frame(foot.body)
            sole = attitude.apply(foot.sole)
            state = self._bullet.getLinkState(self._robot, link, computeLinkVelocity=1)
            # The velocity is that of the centre of mass.
            velocity = np.array(state[6]) + np.cross(state[7], position + sole - np.array(state[0]))
            touch = sum(c[9] for c in self._bullet.getContactPoints(self._robot, self._floor, link, -1))
            values = (
                touch,
                position + sole,
                velocity,
                attitude.apply([0.0, 0.0, 1.0]),
                attitude.apply([1.0, 0.0, 0.0]),
            )
            for kind, value in zip(("touch", "pos", "vel", "up", "forward"), values, strict=True):
                self._sensors[f"{foot.side}_foot_{kind}"][:] = value
