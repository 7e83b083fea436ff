"""Joint torques that make H1's hands as stiff as asked, at any pose. Run by the tests."""

import torch

from cotap.compliance import ArmKinematics, modulate_stiffness, resolve_joint_stiffness, singularity_aware_ratio

arms = ArmKinematics()  # both arms of the Unitree H1
q = torch.tensor([[0.0, 0.2, 0.0, 0.3, 0.0, -0.2, 0.0, 0.3]])  # joint angles now [rad]
q_wanted = q + 0.05
jacobian = arms.jacobian(q)  # (1, 2, 3, 4)
hand_stiffness = torch.tensor([500.0, 500.0, 100.0]).expand(1, 2, 3)  # stiff sideways, soft vertically [N/m]
k_comp = resolve_joint_stiffness(jacobian, hand_stiffness, null_stiffness=25.0)
k_pd = 100.0 * torch.eye(4).expand_as(k_comp)
k = modulate_stiffness(k_comp, k_pd, singularity_aware_ratio(0.7, jacobian))
torque = (k @ (q_wanted - q).reshape(1, 2, 4, 1)).squeeze(-1)  # plus gravity, minus damping
print(torque)
