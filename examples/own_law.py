"""A law of your own: PD that carries the arms' weight, as soft as `alpha` says; measured under a load on a hand."""

import torch

from cotap.compliance.dynamics import gravity_torque
from cotap.compliance.interface import Arms, ArmState, LawParameters, LawReport, TorqueLaw
from cotap.compliance.laws import LAWS, LawConfig
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.scripted_forces import ForceProfile


class FloatingPD:
    """`tau = tau_gravity + (1 - alpha) kp (target - q) - kd dq`."""

    def __init__(self, arms: Arms) -> None:
        self._arms = arms

    def __call__(self, state: ArmState, parameters: LawParameters) -> tuple[TorqueLaw, LawReport]:
        arms, share = self._arms, 1.0 - parameters.alpha.unsqueeze(-1)
        gain = share * arms.kp  # (N, A, n)
        gravity = gravity_torque(arms.inertias, state.pose, state.to_heading[:, 2])
        damping = torch.diag_embed(arms.kd.expand_as(gain))
        elastic = gain * (state.target - state.position)
        law = TorqueLaw(state.position, gravity, elastic, torch.diag_embed(gain), damping)
        return law, LawReport({"gain": gain.mean(-1)})


LAWS["floating-pd"] = lambda arms, _: FloatingPD(arms)  # in the package: one line in `LAWS`

cfg = HumanoidEnvConfig(num_envs=2, num_threads=1, fixed_base=True)
cfg.upper_body.left = LawConfig("floating-pd", alpha=0.6)
cfg.randomization.enabled = False
cfg.forces.scripted = ForceProfile((0.0, 0.0, -5.0), "left", start_s=1.0)
env = HumanoidEnv(cfg)
env.motions.hold(env.motions.default)
env.upper_body.parameters.alpha[1] = 0.0  # envs may differ, at any step
env.reset()
for _ in range(50):
    env.step(torch.zeros(2, env.num_actions))
before = env.state.arms.tip[:, 0, 2].clone()
for _ in range(100):
    env.step(torch.zeros(2, env.num_actions))
sag = before - env.state.arms.tip[:, 0, 2]
print(sag)  # [m], the soft arm's and the stiff one's
