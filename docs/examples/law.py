"""A law of one's own: PD that bears the arms' weight, as soft as `alpha` says. Run in a world with a load on a hand."""

import torch

from cotap.compliance.dynamics import gravity_torque
from cotap.compliance.interface import Arms, ArmState, LawParameters, LawReport, TorqueLaw
from cotap.compliance.laws import LAWS, LawConfig
from cotap.envs import H1Env, H1EnvConfig


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


LAWS["floating-pd"] = lambda arms, _: FloatingPD(arms)  # in the package: a line in `LAWS`

cfg = H1EnvConfig(num_envs=2, num_threads=1, fixed_base=True)
cfg.upper_body.left = LawConfig("floating-pd", alpha=0.6)
cfg.hand_forces.enabled = cfg.randomization.enabled = False
cfg.force.force, cfg.force.start_s = (0.0, 0.0, -5.0), 1.0  # on the left hand [N]
env = H1Env(cfg)
env.motions.hold(env.motions.default)
env.upper_body.parameters.alpha[1] = 0.0  # worlds differ, and may at any step
env.reset()
for _ in range(50):
    env.step(torch.zeros(2, 19))
before = env.state.arms.tip[:, 0, 2].clone()
for _ in range(100):
    env.step(torch.zeros(2, 19))
sag = before - env.state.arms.tip[:, 0, 2]
print(sag)  # [m], the soft arm's and the stiff one's
