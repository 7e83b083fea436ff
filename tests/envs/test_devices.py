"""The environment on a device that is not the CPU: the same numbers, and nothing forgotten on the way."""

from __future__ import annotations

import copy

import pytest
import torch
from elsewhere import DEVICE, Elsewhere, elsewhere

from cotap.compliance.laws import LawConfig
from cotap.envs import HumanoidEnv, HumanoidEnvConfig

STEPS = 12


def everything(robot: str) -> HumanoidEnvConfig:
    """All that an environment can do, at once, and often."""
    cfg = HumanoidEnvConfig(robot=robot, num_envs=3, num_threads=1, unevenness_m=0.02)
    cfg.assist.enabled = True
    cfg.observations.noise.enabled = cfg.observations.goals = True
    cfg.observations.arm_torque, cfg.observations.critic = "critic", "history" if robot == "h1" else "present"
    cfg.upper_body.left = LawConfig(name="cotap" if robot == "h1" else "hmc", sensing="estimated")
    cfg.upper_body.right = LawConfig(name="facet")
    cfg.upper_body.sampling.enabled = True
    cfg.upper_body.sampling.hold_s = (0.1, 0.2)
    cfg.upper_body.torso.model = "support"
    cfg.commands.resample_s = (0.1, 0.3)
    cfg.path.share = 0.5
    forces = cfg.forces
    forces.hand_loads.enabled, forces.hand_loads.hold_s = True, (0.1, 0.2)
    forces.pushes.enabled, forces.pushes.interval_s = True, (0.12, 0.2)
    forces.pushes.ramp.full_samples = 30.0
    forces.scripted.force, forces.scripted.start_s, forces.scripted.random_direction = (5.0, 5.0, 0.0), 0.1, True
    forces.punches.force_n, forces.punches.segment_s = 20.0, 0.2
    cfg.motions.clips.hold_s = (0.1, 0.3)
    cfg.rewards.upper.track_hands_as_facet = cfg.rewards.upper.reference_closeness = 1.0
    cfg.terminations.episode_s = 0.1
    return cfg


def run(cfg: HumanoidEnvConfig) -> list[torch.Tensor]:
    """Steps with actions that fell robots, other laws on the way, and a state that is saved and taken over."""
    env = HumanoidEnv(copy.deepcopy(cfg))
    env.keeps_final_observation = True
    rng = torch.Generator().manual_seed(3)
    seen: list[torch.Tensor] = []
    for step in range(STEPS):
        actions = 3.0 * torch.randn(cfg.num_envs, env.num_actions, generator=rng)
        observations, rewards, dones, extras = env.step(actions.to(env.device))
        seen += [*observations.values(), rewards, dones, *extras["log"].values(), extras["group_rewards"]]
        seen += [env.final_observation] if dones.any() else []
        if step == STEPS // 3:
            env.set_law(1, 0, LawConfig(name="dcc"))
            env.set_law(2, 1, LawConfig())
            env.motions.lead("rest")
            saved = env.state_dict()
        if step == 2 * STEPS // 3:
            env.load_state_dict(saved)
            env.reset_identical(5)
    return seen


@pytest.mark.filterwarnings("ignore:for .* copying from a non-meta parameter:UserWarning")
def test_an_environment_elsewhere_computes_the_same(monkeypatch, robot):
    here = run(everything(robot))
    with elsewhere(monkeypatch.setattr):
        there = run(everything(robot))
        assert all(isinstance(value, Elsewhere) for value in there if value.dim() > 0)
    assert len(here) == len(there)
    for mine, other in zip(here, there, strict=True):
        assert torch.equal(mine, other.held if isinstance(other, Elsewhere) else other)


@pytest.mark.parametrize(
    "forgotten",
    [
        lambda x: x + torch.zeros(3),
        lambda x: torch.stack((x, torch.ones(3))),
        lambda x: torch.where(torch.tensor([True, False, True]), x, x),
        lambda x: x[torch.tensor([0, 1])],
        lambda x: torch.rand(3, generator=torch.Generator()) * x,
        lambda x: x.numpy(),
        lambda x: torch.from_numpy(x.cpu().numpy()) + x,
    ],
)
def test_what_is_forgotten_on_the_processor_is_found(forgotten, monkeypatch):
    with elsewhere(monkeypatch.setattr), pytest.raises(RuntimeError, match=r"on the CPU|numpy"):
        forgotten(torch.ones(3, device=DEVICE))
