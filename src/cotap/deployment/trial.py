"""One robot from start-up to the end of a trial, recorded."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch

from cotap.deployment.controller import Controller, termination_config
from cotap.deployment.joint_law import damped_law
from cotap.deployment.robot import Robot
from cotap.deployment.safety import SafetyConfig, Watchdog
from cotap.deployment.scenario import Scenario
from cotap.envs.state import RobotState
from cotap.envs.terminations import diverged, fallen
from cotap.evaluation.rollout import Trajectory, state_row

Pilot = Callable[[Controller, float], bool]
"""Called at every control step with the time [s]: may change commands, and says whether to go on."""
STOP_S = 1.0
"""How long a robot that fell or stopped itself is recorded [s]."""


@dataclass
class Trial:
    """What happened. T control steps."""

    dt: float
    rows: list[dict[str, torch.Tensor]] = field(default_factory=list)
    """Fields of a `Trajectory`, (1, ...) each."""
    qpos: list[np.ndarray] = field(default_factory=list)
    """(T) of (7 + J,)."""
    stopped: str = ""
    """Why the robot stopped itself; empty if it did not."""
    stopped_at_s: float | None = None
    stores: list[tuple[torch.Tensor, torch.Tensor]] = field(default_factory=list)
    """(T) of level [J] and share held back, (1, A) each, where arms have an energy store."""
    touched_s: dict[str, float] = field(default_factory=dict)
    """For how long pairs of the robot's own links touched each other before it fell [s]: tripping over itself."""
    fell: bool = False
    """Too low or too tilted, or stopped: what a stopped robot goes on to do is no merit of its policy."""


def start_up(robot: Robot, controller: Controller, safety: SafetyConfig, seed: int) -> None:
    """Bring the robot to its first pose with rising gains while its base is held, and let it go."""
    controller.restart()
    default = np.array([j.default_rad for j in robot.spec.joints])
    pose = np.concatenate((default[: len(robot.spec.lower_joints)], controller.initial_arms))
    robot.start(pose, seed)
    if safety.ramp_s == 0.0:
        return
    ramp = round(safety.ramp_s / controller.dt)
    free = np.zeros((len(robot.spec.arms), 3))
    robot.engine.hold(True)
    for k in range(ramp):
        robot.act(robot.holding(pose).ramped((k + 1) / ramp), free)
    for _ in range(round(safety.settle_s / controller.dt)):
        robot.act(robot.holding(pose), free)
    robot.engine.hold(False)


@torch.inference_mode()
def run_trial(
    robot: Robot, controller: Controller, scenario: Scenario, safety: SafetyConfig, seed: int = 0,
    pilot: Pilot | None = None,
) -> Trial:  # fmt: skip
    """Start the robot up and run the scenario until its end, a fall, or a stop and what follows it."""
    commands, dt, trial = list(scenario.command), controller.dt, Trial(controller.dt)
    if commands:  # the robot begins with it, it need not change over
        commands[0].give(controller.commands, robot.spec.nominal_height_m)
    start_up(robot, controller, safety, seed)
    watchdog = Watchdog(safety, robot.spec.joint_names, robot.torque_limit, dt)
    forces, falling = scenario.forces(robot.spec, dt, seed), termination_config(controller.metadata)
    min_height_m = falling.min_height_m(robot.spec)
    left = math.inf
    for k in range(round(scenario.seconds / dt)):
        while commands and commands[0].at <= k * dt + 1e-9:
            commands.pop(0).give(controller.commands, robot.spec.nominal_height_m)
        if pilot and not pilot(controller, k * dt):
            break
        law = damped_law(robot.damping)
        if not trial.stopped:
            readings = robot.read()
            trial.stopped = watchdog.of_readings(readings)
            if not trial.stopped:
                asked = controller.step(readings)
                trial.stopped = watchdog.of_law(asked)
                law = law if trial.stopped else asked
            if trial.stopped:
                trial.stopped_at_s = k * dt
            elif "store_energy" in (report := controller.upper_body.report):
                trial.stores.append((report["store_energy"], report["held_back"]))
        push = sum(
            (f.at(torch.tensor([k * dt]))[0, :-1].double().numpy() for f in forces), np.zeros((len(robot.spec.arms), 3))
        )
        robot.act(law, push, at_once=bool(trial.stopped))
        qpos, qvel = (torch.from_numpy(x).unsqueeze(0) for x in (robot.engine.qpos, robot.engine.qvel))
        if diverged(qpos, qvel).any():
            trial.fell, trial.stopped = True, trial.stopped or "the simulation diverged"
            break
        truth = robot.truth()
        down = bool(fallen(truth.height, truth.projected_gravity_t, min_height_m, falling.max_tilt_rad))
        trial.fell = trial.fell or down or bool(trial.stopped)
        for pair in () if trial.fell else sorted(robot.engine.touching()):
            name = " and ".join(pair)
            trial.touched_s[name] = trial.touched_s.get(name, 0.0) + dt
        trial.rows.append(_row(robot, controller, truth, push, trial.fell))
        trial.qpos.append(robot.engine.qpos.copy())
        if trial.fell:
            left = min(left, round(STOP_S / dt)) - 1
        if left <= 0:
            break
    return trial


def _row(
    robot: Robot, controller: Controller, s: RobotState, force_h: np.ndarray, fell: bool
) -> dict[str, torch.Tensor]:
    reference = controller.motion.current().position.double()
    return state_row(
        s, controller.commands, reference, torch.from_numpy(robot.torque()).unsqueeze(0),
        torch.from_numpy(robot.torque_limit), s.arms.tip - controller.arm_pose(reference).tip,
        torch.from_numpy(force_h).unsqueeze(0) @ s.heading_w.transpose(1, 2), controller.upper_body.arms,
        torch.full_like(s.height, math.nan), torch.tensor([fell]),
    )  # fmt: skip


def trajectory(trials: list[Trial], steps: int) -> Trajectory:
    """Trials as envs (T, N, ...). A trial that ended early is fallen from then on; its last row is repeated."""
    columns: dict[str, list[torch.Tensor]] = {}
    for trial in trials:
        rows = trial.rows[:steps]
        rows = rows + [rows[-1] | {"fell": torch.tensor([True])}] * (steps - len(rows))
        for name in rows[0]:
            value = torch.stack([row[name] for row in rows])
            columns.setdefault(name, []).append(value if value.dtype == torch.bool else value.float())
    return Trajectory(trials[0].dt, **{name: torch.cat(values, 1) for name, values in columns.items()})
