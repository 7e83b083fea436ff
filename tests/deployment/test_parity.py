"""One world of the batched simulation against the deployment loop, at the same settings."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cotap.agents.actors import as_dict
from cotap.deployment.controller import Controller
from cotap.deployment.engines import EngineConfig, make_engine
from cotap.deployment.robot import Perturbations, Robot
from cotap.deployment.scenario import ArmMotion
from cotap.envs import H1Env
from cotap.envs.upper_body import UpperBodyConfig
from cotap.evaluation.policy import load_policy, shipped_checkpoint


def laws_named(name: str) -> UpperBodyConfig:
    laws = UpperBodyConfig()
    if name != "pd":
        laws.left.name, laws.left.stiffness, laws.left.alpha = "cotap", (500.0, 400.0, 150.0), 0.8
        laws.right.name, laws.right.error = "cotap", "task"
        laws.right.damping = "critical"
    if name == "mixed":
        laws.left.name = "pd"
    return laws


def batched(
    laws: UpperBodyConfig, stand: float, seconds: float, leans: bool
) -> tuple[H1Env, list[np.ndarray], list[np.ndarray], dict]:
    """A held robot on a policy that walks in the air: its joints (T, J), torques (T, U), and how it began."""
    policy = load_policy(shipped_checkpoint("base"))
    cfg = policy.env_config
    cfg.num_envs, cfg.num_threads, cfg.fixed_base, cfg.upper_body = 1, 1, True, laws
    if not leans:
        cfg.commands.lean_into_loads, cfg.commands.brace_tilt_rad = False, 0.0
    cfg.collision = "feet"  # as the engine below: rounding grows where legs touch
    cfg.assist.enabled = cfg.hand_forces.enabled = cfg.blows.enabled = cfg.randomization.enabled = False
    cfg.motions.clips.only, cfg.motions.clips.share = ("punch",), 1.0
    cfg.force.force, cfg.force.hand, cfg.force.start_s = (8.0, -5.0, -6.0), "both", 0.5
    env = H1Env(cfg)
    walk = 1.0 - stand
    env.commands.override(
        torch.tensor([[0.6, 0.2]]) * walk, torch.tensor([0.4]) * walk, torch.tensor([stand]), torch.tensor([1.0])
    )
    obs = env.reset()
    start = {
        "qpos": env.sim.qpos[0].numpy().copy(), "qvel": env.sim.qvel[0].numpy().copy(),
        "commands": env.commands.state_dict(), "motion": env.motions.state_dict(),
    }  # fmt: skip
    joints, torques = [], []
    for _ in range(round(seconds / env.dt)):
        obs, _, dones, _ = env.step(policy(as_dict(obs)))
        assert not dones.any()
        joints.append(env.sim.qpos[0, 7:].numpy().copy())
        torques.append(env.joint_torque(env.state)[0].numpy().copy())
    return env, joints, torques, start


# Standing is fed back for feet on the ground: in the air it oscillates, and rounding grows tenfold every 0.2 s.
@pytest.mark.parametrize(
    ("law", "stand", "seconds", "leans"),
    [("pd", 0.0, 2.0, False), ("cotap", 0.0, 2.0, False), ("mixed", 0.0, 2.0, False), ("pd", 1.0, 0.6, False),
     ("pd", 0.0, 2.0, True), ("cotap", 0.0, 2.0, True)],
)  # fmt: skip
def test_the_loop_is_the_batched_environment(law, stand, seconds, leans, policy, spec):
    laws = laws_named(law)
    env, expected, torques, start = batched(laws, stand, seconds, leans)
    motion = ArmMotion(clip="punch").reference(spec, env.dt)
    engine_cfg = EngineConfig(timestep=0.01, collision="feet", cone="pyramidal")
    robot = Robot(make_engine(engine_cfg, spec), engine_cfg, spec, env.dt, Perturbations())
    controller = Controller(policy, spec, laws, env.cfg.commands, motion, seed=1)
    controller.commands.resample = False
    controller.commands.load_state_dict(start["commands"])
    controller.motion.load_state_dict(start["motion"])
    robot.place(start["qpos"], start["qvel"])
    robot.engine.hold(True)
    moved = 0.0
    for k, (joints, torque) in enumerate(zip(expected, torques, strict=True)):
        push = env.scripted.at(torch.tensor([k * env.dt]))[0, :-1].double().numpy()
        robot.act(controller.step(robot.read()), push)
        np.testing.assert_allclose(robot.engine.qpos[7:], joints, atol=1e-4, err_msg=f"step {k}")
        np.testing.assert_allclose(robot.torque(), torque, atol=0.05, err_msg=f"step {k}")
        moved = max(moved, float(np.abs(joints - start["qpos"][7:]).max()))
    assert moved > (0.1 if stand else 0.3)  # the policy did something
