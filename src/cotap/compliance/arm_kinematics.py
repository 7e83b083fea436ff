"""Arms on pytorch-kinematics chains, for use outside of rollouts (which use `SerialChains`, and agree with it)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from cotap.compliance.arguments import full_precision, require_floats

if TYPE_CHECKING:
    from cotap.robots import ArmSpec, RobotSpec


class ArmKinematics:
    """Hand positions and Jacobians of a robot's arms, in the frame of the torso link that carries them.

    Both are differentiable to any order. They take batches, and so need no `torch.vmap`, which they do not support.

    Args:
        spec: The robot; by default the Unitree H1. Its arms must have equally many joints.
        dtype: Of all results, torch.float32 or torch.float64.
        device: Where they are computed.

    Raises:
        ValueError: another dtype.
    """

    def __init__(
        self, spec: RobotSpec | None = None, dtype: torch.dtype = torch.float32, device: str | torch.device = "cpu"
    ) -> None:
        if dtype not in (torch.float32, torch.float64):
            raise ValueError(f"dtype must be torch.float32 or torch.float64, got {dtype}")
        if spec is None:
            from cotap.robots import h1

            spec = h1()
        self.spec, self.dtype, self.device = spec, dtype, torch.device(device)
        self._chains = [_serial_chain(spec, arm).to(dtype=dtype, device=self.device) for arm in spec.arms]
        self.num_joints = len(spec.arms[0].joints)

    def hand_position(self, q: torch.Tensor) -> torch.Tensor:
        """Hands (N, A, 3) [m] for arm joints `q`, (N, A, n) or (N, A n) [rad].

        Raises:
            ValueError: `q` has another shape or is not of finite float32 or float64 numbers.
        """
        return torch.stack([pose[:, :3, 3] for _, pose in self._along(q)], 1)

    def jacobian(self, q: torch.Tensor) -> torch.Tensor:
        """Jacobians (N, A, 3, n) [m/rad] of the hand positions, for arm joints `q`, (N, A, n) or (N, A n) [rad].

        Raises:
            ValueError: `q` has another shape or is not of finite float32 or float64 numbers.
        """
        return torch.stack([jacobian[:, :3] for jacobian, _ in self._along(q)], 1)

    @full_precision
    def _along(self, q: torch.Tensor) -> list[tuple[torch.Tensor, torch.Tensor]]:
        """Of each arm the Jacobian (N, 6, n) and the pose (N, 4, 4) of its hand."""
        out = []
        for chain, angles in zip(self._chains, self._split(q).unbind(1), strict=True):
            # The library's analytical gradient has no derivatives: those beyond the first come out wrong.
            poses = chain.forward_kinematics_tensor(angles, analytical_grad=False)
            out.append(chain.jacobian_tensor(angles, ret_eef_pose=True, all_transforms=poses))
        return out

    def _split(self, q: torch.Tensor) -> torch.Tensor:
        require_floats("q", q)
        arms, joints = len(self._chains), self.num_joints
        if q.dim() == 2 and q.shape[1] == arms * joints:
            q = q.unflatten(1, (arms, joints))
        if q.dim() != 3 or tuple(q.shape[1:]) != (arms, joints):
            raise ValueError(f"q must have shape (N, {arms}, {joints}) or (N, {arms * joints}), got {tuple(q.shape)}")
        return q.to(dtype=self.dtype, device=self.device)


def _serial_chain(spec: RobotSpec, arm: ArmSpec) -> Any:
    """From the torso link to the hand point. Joint angles are counted in the order of the chain."""
    import pytorch_kinematics as pk  # loads mujoco and matplotlib; whoever imports cotap.compliance needs neither

    axes = {j.name: j.axis for j in spec.joints}

    def offset(position: tuple[float, ...], quat: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)) -> Any:
        return pk.Transform3d(rot=list(quat), pos=list(position), dtype=torch.float64)

    def frame(name: str, joint: Any) -> Any:
        return pk.frame.Frame(name, pk.frame.Link(name, offset((0.0, 0.0, 0.0))), joint)

    nowhere = offset((0.0, 0.0, 0.0))
    root = parent = frame(spec.torso_body, pk.frame.Joint(offset=nowhere, dtype=torch.float64))
    for body in spec.chain(arm.hand_body, spec.torso_body):
        name = body.joint or ""
        joint = pk.frame.Joint(name, offset(body.pos, body.quat), "revolute", axes[name], dtype=torch.float64)
        child = frame(body.name, joint)
        parent.add_child(child)
        parent = child
    tip = pk.frame.Joint(f"{arm.side}_hand_point", offset(arm.hand_point), "fixed", dtype=torch.float64)
    parent.add_child(frame(f"{arm.side}_hand", tip))
    return pk.SerialChain(pk.Chain(root, dtype=torch.float64), f"{arm.side}_hand")
