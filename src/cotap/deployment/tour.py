"""The punch tour in another engine: one run after the other, in the loop of deployment."""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from cotap.deployment.controller import Controller, robot_of
from cotap.deployment.engines import EngineConfig, PointForce, make_engine
from cotap.deployment.graph import export_policy
from cotap.deployment.policy import OnnxPolicy
from cotap.deployment.robot import Perturbations, Robot
from cotap.envs import HumanoidEnvConfig
from cotap.envs.punches import Punches
from cotap.envs.terminations import diverged
from cotap.evaluation.rollout import film_row
from cotap.evaluation.tour.arm_walk import arms_at
from cotap.evaluation.tour.protocol import CONTROL_S, PHYSICS_S, Tour
from cotap.evaluation.tour.route import Pilot
from cotap.evaluation.tour.scores import TourMeasures
from cotap.evaluation.tour.stance import TourStance
from cotap.motions.generator import ArmReference
from cotap.robots import RobotSpec
from cotap.rotations import yaw_of


class _Walk:
    """The arms' random walk, as a controller follows it.

    Args:
        targets: (1, K + 1, U) [rad].
    """

    def __init__(self, targets: torch.Tensor) -> None:
        self._targets, self._step = targets, 0

    def reset(self, mask: torch.Tensor, rng: torch.Generator) -> None:  # noqa: ARG002
        """Begin anew."""
        self._step = 0

    def step(self, rng: torch.Generator) -> None:  # noqa: ARG002
        """Advance by one control step."""
        self._step += 1

    def current(self) -> ArmReference:
        """The reference now."""
        return ArmReference(*arms_at(self._targets, CONTROL_S * self._step))


def evaluate_in_engine(tour: Tour, checkpoint: Path, cfg: HumanoidEnvConfig) -> dict[str, Any]:
    """The measured part of the evaluation's JSON.

    Args:
        tour: The protocol, prepared; its `engine` says where. Its `film` becomes that of the first run.
        checkpoint: The policy.
        cfg: The environment that the protocol makes of the policy's own: laws of the arms, limits of commands.

    Raises:
        ValueError: the policy or a law cannot be deployed.
        ModuleNotFoundError: the engine is not installed.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "policy.onnx"
        export_policy(checkpoint, path)
        policy = OnnxPolicy(path)
    laws, spec = cfg.upper_body, robot_of(policy.metadata)
    if laws.left.name == laws.right.name == "pd":
        spec = _with_arm_gains(spec, tour.stance)
    engine_cfg = EngineConfig(tour.engine, PHYSICS_S, torque_limit_scale=tour.torque_limit_scale)
    engine = make_engine(engine_cfg, spec)
    try:
        robot = Robot(engine, engine_cfg, spec, CONTROL_S, Perturbations())
        runs: list[TourMeasures] = []
        for run in tqdm(range(tour.num_envs), desc="runs", disable=None, leave=False):
            waypoints, targets = tour.draw(spec, tour.stance, range(run, run + 1))
            controller = Controller(policy, spec, laws, cfg.commands, _Walk(targets), run, tour.upper_actions)
            punches = Punches(cfg.forces.punches, len(spec.joints), 1, CONTROL_S, first_run=run)
            measures, film = _run(tour, robot, controller, waypoints, punches)
            runs.append(measures)
            tour.film = film if run == 0 else tour.film
    finally:
        engine.close()
    return TourMeasures.join(runs).report(tour.segment_s, CONTROL_S, tour.seed, tour.per_env)


@torch.inference_mode()
def _run(
    tour: Tour, robot: Robot, controller: Controller, waypoints: torch.Tensor, punches: Punches
) -> tuple[TourMeasures, torch.Tensor]:
    """One run, and its film (T, nq + 6 H)."""
    start, joints = tour.stance.start().double().numpy(), len(robot.spec.joints)
    robot.place(start, np.zeros(len(start) - 1))
    _ask(controller, torch.zeros(1, 2), torch.zeros(1), torch.zeros(1), robot.spec)
    controller.restart()
    pilot = Pilot(waypoints, tour.segment_s, controller.commands.cfg, *_pelvis(robot), tour.speed_limit)
    scorer, free = tour.scorer(1, joints), np.zeros((len(robot.spec.arms), 3))
    links = {body.joint: body.name for body in robot.spec.bodies}
    film: list[torch.Tensor] = []
    for step in range(tour.waypoints * tour.segment_steps):
        time_s = step * CONTROL_S
        asked = pilot.command(time_s, *_pelvis(robot), robot.truth().heading_w)
        law, pushes = controller.step(robot.read()), []
        _ask(controller, *asked, robot.spec)  # seen at the next step, as in batched MuJoCo
        if punches.active:
            joint, force_w = (part[0] for part in punches.at(torch.tensor([time_s])))
            link = links[robot.spec.joint_names[joint]]
            pushes = [PointForce(link, (0.0, 0.0, 0.0), force_w.numpy())] if force_w.any() else []
        robot.act(law, free, others=pushes)
        qpos, qvel = (torch.from_numpy(x.copy())[None] for x in (robot.engine.qpos, robot.engine.qvel))
        way, turn = pilot.error(step // tour.segment_steps, *_pelvis(robot))
        torque = torch.from_numpy(robot.torque())[None]
        scorer.step(qpos[:, 2], qvel[:, 6:], torque, way, turn, diverged(qpos, qvel))
        hands_t = controller.arm_pose(controller.motion.current().position.double()).tip[0]
        film.append(film_row(qpos[0], robot.truth(), hands_t, torch.zeros_like(hands_t)))
        if not scorer.standing.any():
            break
    return scorer.measures(), torch.stack(film)


def _ask(
    controller: Controller, velocity: torch.Tensor, yaw_rate: torch.Tensor, stand: torch.Tensor, spec: RobotSpec
) -> None:
    """Command velocities at nominal height."""
    height = torch.full_like(yaw_rate, spec.nominal_height_m)
    controller.commands.override(*(part.float() for part in (velocity, yaw_rate, stand, height)))


def _pelvis(robot: Robot) -> tuple[torch.Tensor, torch.Tensor]:
    """Where the base is: (1, 2) [m] and yaw (1,) [rad]."""
    return torch.tensor(robot.engine.qpos[None, :2]), yaw_of(robot.truth().base_rotation_w)


def _with_arm_gains(spec: RobotSpec, stance: TourStance) -> RobotSpec:
    """The robot with the gains of the tour in its arms."""
    gains = zip(spec.upper_joints, stance.arm_kp.tolist(), stance.arm_kd.tolist(), strict=True)
    by_name = {name: {"kp": kp, "kd": kd} for name, kp, kd in gains}
    return dataclasses.replace(
        spec, joints=tuple(dataclasses.replace(j, **by_name.get(j.name, {})) for j in spec.joints)
    )
