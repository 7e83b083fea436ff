"""The environment against the deployed loop, at the same settings: one robot, base held, legs and arms in motion."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from cotap.agents.actors import as_dict
from cotap.deployment.controller import Controller
from cotap.deployment.engines import EngineConfig, make_engine
from cotap.deployment.policy import OnnxPolicy
from cotap.deployment.robot import Perturbations, Robot
from cotap.envs import HumanoidEnv
from cotap.envs.upper_body import UpperBodyConfig
from cotap.evaluation.policy import load_policy
from cotap.motions.reference import ReferenceMotion

SECONDS = 2.0
ENGINE = EngineConfig(timestep=0.01, collision="feet", cone="pyramidal")


def laws_named(name: str) -> UpperBodyConfig:
    laws = UpperBodyConfig()
    if name != "pd":
        laws.left.name, laws.left.stiffness, laws.left.alpha = "cotap", (500.0, 400.0, 150.0), 0.8
        laws.right.name, laws.right.error = "cotap", "task"
        laws.right.damping = "critical"
    if name == "mixed":
        laws.left.name = "pd"
    return laws


def held_env(checkpoint, laws: UpperBodyConfig) -> HumanoidEnv:
    """One robot in the air that walks for a fifth of a second and is then asked to stand, forces on its hands."""
    cfg = load_policy(checkpoint).env_config
    cfg.fixed_base, cfg.upper_body, cfg.collision = True, laws, "feet"
    cfg.randomization.enabled = False
    cfg.forces.scripted.force, cfg.forces.scripted.hand, cfg.forces.scripted.start_s = (8.0, -5.0, -6.0), "both", 0.5
    return HumanoidEnv(cfg)


def command(commands, walk: bool, height: float) -> None:
    on = float(walk)
    commands.override(
        torch.tensor([[0.6, 0.2]]) * on, torch.tensor([0.4]) * on, torch.tensor([1.0 - on]), torch.tensor([height])
    )


def beside_it(env: HumanoidEnv, policy: OnnxPolicy, laws: UpperBodyConfig) -> tuple[Robot, Controller]:
    """The deployed loop, begun where the environment begins."""
    spec = env.spec
    robot = Robot(make_engine(ENGINE, spec), ENGINE, spec, env.dt, Perturbations())
    controller = Controller(policy, spec, laws, env.cfg.commands, ReferenceMotion(env.cfg.motions, spec, 1, env.dt), 1)
    env.rng.manual_seed(1)  # both draw the arms' motion alike
    controller.commands.resample = False
    controller.commands.load_state_dict(env.commands.state_dict())
    controller.motion.load_state_dict(env.motions.state_dict())
    robot.place(env.sim.qpos[0].numpy().copy(), env.sim.qvel[0].numpy().copy())
    robot.engine.hold(True)
    return robot, controller


class Watched(OnnxPolicy):
    """Keeps what it has observed last."""

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        self.observed = observation
        return super().__call__(observation)


KINDS = [(robot, mode, "pd") for robot in ("h1", "made-up") for mode in ("residual", "absolute")]
KINDS += [("h1", "residual", "cotap"), ("h1", "absolute", "cotap"), ("h1", "residual", "mixed")]
KINDS += [("g1", "absolute", "pd"), ("g1", "residual", "cotap")]
MODULATED = [("h1", "stiffness"), ("g1", "alpha"), ("made-up", "stiffness")]


@pytest.mark.parametrize(("name", "mode", "law"), KINDS)
def test_the_loop_is_the_environment(name, mode, law, random_checkpoint, random_policy):
    kind: dict[str, Any] = {"robot": name, "upper_mode": mode, "output_gain": 0.3}
    side_by_side(random_checkpoint(**kind), random_policy(**kind), laws_named(law))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "modulation"), MODULATED)
def test_the_loop_is_the_environment_where_the_policy_sets_the_laws(name, modulation, random_checkpoint, random_policy):
    kind: dict[str, Any] = {"robot": name, "output_gain": 1.0, "modulation": modulation}
    laws = load_policy(random_checkpoint(**kind)).env_config.upper_body
    env, controller = side_by_side(random_checkpoint(**kind), random_policy(**kind), laws)
    here, there = env.upper_body.parameters, controller.upper_body.parameters
    torch.testing.assert_close(here.alpha.double(), there.alpha, atol=1e-5, rtol=0.0)
    torch.testing.assert_close(here.stiffness.double(), there.stiffness, atol=0.0, rtol=1e-5)
    began = torch.tensor([[0.4, 0.6]])
    assert float((here.alpha - began).abs().max()) > 0.01  # the policy set something
    assert (modulation == "stiffness") == (float((here.stiffness[0, 1] / 300.0).log().abs().max()) > 0.02)


def by_term(env: HumanoidEnv, here: np.ndarray, there: np.ndarray) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Two observations, cut into their terms with all of their history."""
    layout = env.observer.layout()
    names = [name for name, _, _ in layout["terms"]]
    ends = np.cumsum([width * layout["history"] for _, width, _ in layout["terms"]])
    assert here.shape == there.reshape(-1).shape == (ends[-1],)
    return list(zip(names, np.split(here, ends[:-1]), np.split(there.reshape(-1), ends[:-1]), strict=True))


def side_by_side(checkpoint, exported, laws: UpperBodyConfig) -> tuple[HumanoidEnv, Controller]:
    """Run both for a while, and compare what they observe, send and become at every step."""
    in_torch = load_policy(checkpoint)
    env = held_env(checkpoint, laws)
    nominal, start = env.spec.nominal_height_m, env.state.joint_pos
    command(env.commands, True, nominal)
    obs = env.reset()
    policy = Watched(exported)
    robot, controller = beside_it(env, policy, laws)
    moved = 0.0
    for k in range(round(SECONDS / env.dt)):
        push = env.forces.scripted.at(torch.tensor([k * env.dt]))[0, :-1].double().numpy()
        asked = controller.step(robot.read())
        for name, here, there in by_term(env, obs["policy"][0].numpy(), policy.observed):
            nearly = 3e-5 if name == "arm_torque" else 1e-5  # torques are of some 10 Nm, in single precision
            np.testing.assert_allclose(there, here, 1e-5, nearly, err_msg=f"step {k}, {name}")
        if k == 10:
            for commands in (env.commands, controller.commands):
                command(commands, False, nominal - 0.1)
        obs, _, dones, _ = env.step(in_torch(as_dict(obs)))
        assert not dones.any()
        np.testing.assert_allclose(controller.targets, env.actuation.current[0].numpy(), 0.0, 1e-5, err_msg=f"step {k}")
        robot.act(asked, push)
        np.testing.assert_allclose(robot.engine.qpos[7:], env.sim.qpos[0, 7:].numpy(), 0.0, 1e-5, err_msg=f"step {k}")
        moved = max(moved, float((env.state.joint_pos - start).abs().max()))
    assert env.commands.current().stand.all()  # walked, and came to rest
    assert moved > 0.1  # the policy did something
    return env, controller
