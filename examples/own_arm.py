"""The law on an arm of your own, in plain MuJoCo: is the stiffness that is felt the one that was asked for?"""

import mujoco
import numpy as np
import torch

from cotap.compliance import resolve_joint_stiffness

ARM = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
  <body><joint axis="0 1 0"/><joint axis="1 0 0"/><joint axis="0 0 1"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.04" mass="2"/>
    <body pos="0 0 -0.3"><joint axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="1"/>
      <site name="hand" pos="0.3 0 0"/>
</body></body></worldbody></mujoco>"""
ASKED = np.array([500.0, 500.0, 100.0])  # along x, y, z of the world [N/m]
TARGET = np.array([0.3, 0.2, 0.0, -0.4])  # where the joints are sent [rad]
DAMPING = 3.0  # [Nms/rad]


def jacobian(model: mujoco.MjModel, data: mujoco.MjData) -> torch.Tensor:
    """Of the hand's position, (3, n)."""
    rows = np.zeros((3, model.nv))
    mujoco.mj_jacSite(model, data, rows, None, model.site("hand").id)
    return torch.from_numpy(rows)


def displacement(force: np.ndarray, seconds: float = 6.0) -> np.ndarray:
    """How far the hand goes (3,) [m] under a force (3,) [N] on it."""
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    data.qpos[:] = TARGET
    mujoco.mj_forward(model, data)
    start = data.site("hand").xpos.copy()
    for step in range(round(seconds / model.opt.timestep)):
        j = jacobian(model, data)
        if step % 10 == 0:  # stiffness 50 times a second, torque at every step
            stiffness = resolve_joint_stiffness(j, torch.from_numpy(ASKED), null_stiffness=20.0).numpy()
        torque = stiffness @ (TARGET - data.qpos) - DAMPING * data.qvel + data.qfrc_bias
        data.qfrc_applied[:] = torque + j.numpy().T @ force
        mujoco.mj_step(model, data)
    return data.site("hand").xpos - start


if __name__ == "__main__":
    for axis, force in zip("xyz", np.eye(3), strict=True):
        felt, asked = 1e3 * displacement(force), 1e3 * force / ASKED  # the closed form: K^-1 f
        print(f"1 N along {axis} moves the hand by {felt.round(2)} mm, asked for {asked.round(2)} mm")
