"""High-fidelity MuJoCo: full collision, small steps, elliptic friction cones, implicit damping, torque limits."""

from __future__ import annotations

# MuJoCo's extension module has no type stubs.
# pyright: reportAttributeAccessIssue=false
from collections.abc import Sequence

import mujoco
import numpy as np

from cotap.deployment.engines import EngineConfig, PointForce
from cotap.deployment.joint_law import JointLaw
from cotap.robots import RobotSpec
from cotap.robots.mjcf import build_mjspec, hold_base

_CONES = {"elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC, "pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL}


class MujocoEngine:
    """One robot in MuJoCo, with the same model that everything trains on, set up finer.

    The diagonal of the law's damping is integrated implicitly, as a motor driver's own velocity loop would act.
    """

    def __init__(self, cfg: EngineConfig, spec: RobotSpec) -> None:
        mj = build_mjspec(spec, cfg.collision, cfg.timestep)
        hold_base(mj, spec)
        self.model = model = mj.compile()
        model.opt.cone = _CONES[cfg.cone]
        model.eq_active0[:] = 0
        model.actuator_forcerange[:] *= cfg.torque_limit_scale
        model.actuator_biasprm[:] = 0.0
        feet = {model.body(foot.body).id for foot in spec.feet}
        model.geom_friction[[g for g in range(model.ngeom) if model.geom_bodyid[g] in feet], 0] = cfg.friction
        self.data = mujoco.MjData(model)
        self.qpos, self.qvel = self.data.qpos, self.data.qvel
        self._mass, self._inertia = model.body_mass.copy(), model.body_inertia.copy()

    def sensor(self, name: str) -> np.ndarray:
        """As `Engine.sensor`."""
        sensor = self.model.sensor(name)
        return self.data.sensordata[sensor.adr[0] : sensor.adr[0] + sensor.dim[0]]

    def reset(self, qpos: np.ndarray, qvel: np.ndarray, mass_scale: float) -> None:
        """As `Engine.reset`."""
        self.model.body_mass[:], self.model.body_inertia[:] = mass_scale * self._mass, mass_scale * self._inertia
        mujoco.mj_setConst(self.model, self.data)
        mujoco.mj_resetData(self.model, self.data)
        self.qpos[:], self.qvel[:] = qpos, qvel
        mujoco.mj_forward(self.model, self.data)

    def hold(self, held: bool) -> None:
        """As `Engine.hold`."""
        equality = self.model.equality("fixed_base").id
        if held:
            inverse, origin = np.zeros(4), np.zeros(3)
            mujoco.mju_negPose(origin, inverse, self.qpos[:3], self.qpos[3:7])
            self.model.eq_data[equality, 3:10] = np.concatenate((origin, inverse))
        self.data.eq_active[equality] = held

    def advance(self, law: JointLaw, steps: int, forces: Sequence[PointForce]) -> None:
        """As `Engine.advance`."""
        model, data = self.model, self.data
        damping = np.diag(law.damping)
        model.actuator_biasprm[:, 2] = -damping
        self._push(forces)
        q, dq = data.qpos[7:], data.qvel[6:]
        for _ in range(steps):
            data.ctrl[:] = law.torque(q, dq) + damping * dq
            mujoco.mj_step(model, data)

    def touching(self) -> set[tuple[str, str]]:
        """As `Engine.touching`."""
        bodies = self.model.geom_bodyid[self.data.contact.geom]
        pairs = (sorted(self.model.body(b).name for b in pair) for pair in bodies[(bodies > 0).all(1)])
        return {(first, second) for first, second in pairs}

    def close(self) -> None:
        """As `Engine.close`."""

    def _push(self, forces: Sequence[PointForce]) -> None:
        self.data.xfrc_applied[:] = 0.0
        if forces:
            mujoco.mj_kinematics(self.model, self.data)
        for force in forces:
            body = self.model.body(force.body).id
            # MuJoCo takes a wrench at the centre of mass.
            lever_w = self.data.xmat[body].reshape(3, 3) @ (np.array(force.point) - self.model.body_ipos[body])
            self.data.xfrc_applied[body] += np.concatenate((force.force_w, np.cross(lever_w, force.force_w)))
