"""Every law's static displacement in simulation, pelvis fixed, against what its springs add up to."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from cotap.compliance.laws import reads
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.rollout import idle
from cotap.evaluation.static import StaticStiffness, measure

LOAD, STIFFNESS, WEIGHT = (1.0, -1.0, -2.0), np.array([500.0, 300.0, 400.0]), 0.6
ARM = slice(11, 15)


def springs(env: HumanoidEnv) -> tuple[np.ndarray, np.ndarray]:
    """MuJoCo's own Jacobian (3, 4) of the left hand and stiffness (4, 4) of gravity, at the pose without a load."""
    model, data = env.sim.model, mujoco.MjData(env.sim.model)
    start = env.sim.qpos[0].numpy().copy()
    torques = []
    for joint in (None, 0, 1, 2, 3):
        data.qpos[:], data.qvel[:] = start, 0.0
        if joint is not None:
            data.qpos[7 + ARM.start + joint] += 1e-5
        mujoco.mj_forward(model, data)
        torques.append(data.qfrc_bias[6 + ARM.start : 6 + ARM.stop].copy())
    jacobian = np.zeros((3, model.nv))
    data.qpos[:] = start
    mujoco.mj_forward(model, data)
    mujoco.mj_jac(model, data, jacobian, None, data.site("left_hand").xpos, model.body("left_elbow_link").id)
    gravity = np.stack([(t - torques[0]) / 1e-5 for t in torques[1:]], 1)
    return jacobian[:, 6 + ARM.start : 6 + ARM.stop], gravity


def predicted(law: str, env: HumanoidEnv) -> np.ndarray:
    """Displacement (3,) of springs in series: the arm's under its own law, and the reference's."""
    j, gravity = springs(env)
    rigid = np.linalg.inv(np.diag(STIFFNESS))
    kp = (30.0 if law == "soft-pd" else 100.0) * np.eye(4)
    arm = np.linalg.inv(kp + gravity)
    if law in ("pd", "soft-pd"):
        compliance = j @ arm @ j.T
    elif law in ("facet", "dcc"):  # the reference moves by C f, and PD takes the hand along
        compliance = j @ arm @ (kp @ np.linalg.pinv(j) @ rigid + j.T)
    elif law == "hmc":
        felt = WEIGHT * j.T @ np.diag(STIFFNESS) @ j + (1 - WEIGHT) * (kp + gravity)
        compliance = j @ np.linalg.inv(felt) @ j.T
    else:
        compliance = {"cotap": 1.0, "cotap+facet": 2.0, "cotap+facet-matched": 1.0}[law] * rigid
    return compliance @ np.array(LOAD)


@pytest.mark.parametrize("law", ["pd", "soft-pd", "cotap", "facet", "cotap+facet", "cotap+facet-matched", "hmc", "dcc"])
def test_static_displacement_is_what_the_springs_add_up_to(law):
    protocol = StaticStiffness(num_envs=2, force=LOAD, levels=2, settle_seconds=2.0, arm_pose=(0.0, 0.0, 0.0, 0.3))
    cfg = protocol.configure(HumanoidEnvConfig(num_threads=1))
    stiffness = tuple(STIFFNESS.tolist()) if reads(law, "stiffness") else None
    cfg.upper_body = LawOptions(law, stiffness, alpha=WEIGHT if law == "hmc" else None).configure()
    env = HumanoidEnv(cfg)
    protocol.prepare(env)
    moved = measure(env, protocol, idle(env)).displacement[-1].numpy()
    expected = predicted(law, env)
    np.testing.assert_allclose(moved, expected, atol=0.03 * np.abs(expected).max())
