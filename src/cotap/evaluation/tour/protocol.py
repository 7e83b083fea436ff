"""The punch tour in batched MuJoCo: walking to waypoints while arms wander and punches land."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from tensordict import TensorDict
from tqdm import tqdm

from cotap.agents.actors import as_dict
from cotap.checks import LARGEST_SEED, require_one_of, require_positive_int, require_range
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.punches import PunchConfig, Punches
from cotap.evaluation import report
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.protocol import Protocol, select_motion
from cotap.evaluation.rollout import UPPER_ACTIONS, PolicyFunction, acting, picture_row
from cotap.evaluation.tour.arm_walk import INTERVAL_S, ArmWalk, arms_at
from cotap.evaluation.tour.route import Pilot, draw_waypoints
from cotap.evaluation.tour.scores import TourScorer
from cotap.evaluation.tour.stance import TourStance, tour_stance
from cotap.motions.reference import HELD
from cotap.robots import RobotSpec
from cotap.rotations import yaw_of

ENGINES = ("mujoco", "pybullet")
SEED_OFFSET = LARGEST_SEED + 1
"""What is added to the seed of punches, arms and ways: no training may have one that large."""
_WAYPOINTS, _ARMS = 1, 2  # streams of random numbers; that of punches is 0
FALL_S = 2.0
"""How long a film goes on after a fall [s]."""
CONTROL_S, PHYSICS_S = 0.02, 0.002
"""Control and physics step [s]."""


@dataclass
class Tour(Protocol):
    """The punch tour: 90 s of walking to waypoints while arms wander and punches land: survival, errors, energy."""

    laws: ClassVar[LawOptions] = LawOptions(method="pd")
    laws_for_all: ClassVar[bool] = True

    num_envs: int = 512
    """Number of runs, each a tour of its own. A run is the same tour in every engine."""
    randomize: bool = False
    """Vary masses, friction, gains and delay."""
    upper_actions: str = "reference"
    """What moves the arms: reference or policy. reference is the tour's own random walk; policy adds the policy's
    own arm actions to it."""
    force_size: float = 500.0
    """Ceiling of the punches after 60 s [N]. It is a third of that at first; punches are half to all of it."""
    waypoints: int = 18
    """Number of waypoints, and of punches."""
    episode_seconds: float = 90.0
    """Length of a tour, which all waypoints share [s]."""

    speed_limit: float = 0.5
    """Fastest velocity that is commanded [m/s], where the policy's own ranges go further. The benchmark leaves both to
    each policy: HOMIE has 0.4 m/s, decoupled_wbc 0.55 m/s along each axis."""
    engine: str = "mujoco"
    """mujoco or pybullet. mujoco runs all at once, pybullet one after the other in the loop of `cotap deploy`."""
    per_env: bool = False
    """Write survival, completion, energy and vibration of every run as well. `cotap compare` then compares run by
    run."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        super().check()
        require_one_of("engine", self.engine, ENGINES)
        if self.engine != "mujoco":
            self.require_default("randomize", f"in {self.engine}")
        require_range("speed_limit", self.speed_limit, 1e-3, 10.0)
        require_one_of("upper_actions", self.upper_actions, UPPER_ACTIONS)
        require_range("waypoints", require_positive_int("waypoints", self.waypoints), 1, 10_000)
        require_range("episode_seconds", self.episode_seconds, CONTROL_S, 3600.0)
        if abs(self.segment_s - CONTROL_S * self.segment_steps) > 1e-6:
            raise ValueError(
                f"episode_seconds must be waypoints times a multiple of {CONTROL_S} s, got {self.episode_seconds}"
            )
        self.punches().check()

    @property
    def arms(self) -> str:
        """Whether the arms' reference moves: moving or held."""
        return "moving"

    @property
    def segment_s(self) -> float:
        """Time for a waypoint [s]."""
        return self.episode_seconds / self.waypoints

    @property
    def segment_steps(self) -> int:
        """The same in control steps."""
        return round(self.segment_s / CONTROL_S)

    def punches(self) -> PunchConfig:
        """The punches of all runs."""
        return PunchConfig(
            self.force_size, segment_s=self.segment_s, count=self.waypoints, seed=SEED_OFFSET + self.seed
        )

    def scorer(self, num_runs: int, num_joints: int, device: torch.device | str = "cpu") -> TourScorer:
        """Of runs that begin now."""
        return TourScorer(
            num_runs, num_joints, self.waypoints, self.segment_steps, CONTROL_S, self.stance.fallen_height_m, device
        )

    def draw(self, spec: RobotSpec, stance: TourStance, runs: range) -> tuple[torch.Tensor, torch.Tensor]:
        """Waypoints (N, W, 3) and targets of the arms (N, K + 1, U) of these runs, whatever others there are."""

        def stream(run: int, name: int) -> np.random.Generator:
            return np.random.default_rng((SEED_OFFSET + self.seed, run, name))

        waypoints = [draw_waypoints(self.waypoints, stream(run, _WAYPOINTS)).tolist() for run in runs]
        count = int(np.ceil(self.episode_seconds / INTERVAL_S))
        return torch.tensor(waypoints), ArmWalk(spec, stance).draw(count, [stream(run, _ARMS) for run in runs])

    def configure(self, env_cfg: HumanoidEnvConfig) -> HumanoidEnvConfig:
        """Turn the environment that a policy was trained in into this protocol's. Changes and returns `env_cfg`."""
        super().configure(env_cfg)
        select_motion(env_cfg.motions.clips, (HELD,), "")  # arms go where the tour sends them
        if (env_cfg.upper_body.left.name == "pd") != (env_cfg.upper_body.right.name == "pd"):
            raise ValueError("the tour gives PD arms gains of its own, and so needs both arms under PD, or neither")
        if env_cfg.control_dt != CONTROL_S:
            raise ValueError(f"the tour is for policies with a control step of {CONTROL_S} s, got {env_cfg.control_dt}")
        env_cfg.substeps, env_cfg.collision = round(CONTROL_S / PHYSICS_S), "full"
        env_cfg.forces.punches = self.punches()
        # What is a fall is the tour's own business: see TourScorer.
        env_cfg.terminations.min_height, env_cfg.terminations.max_tilt_rad = 0.0, 3.15
        return env_cfg

    def prepare(self, env: HumanoidEnv) -> None:
        """Draw the tours, and give the arms the tour's gains unless a law drives them."""
        super().prepare(env)
        self.stance = tour_stance(env.spec)
        drawn = self.draw(env.spec, self.stance, range(env.num_envs))
        self._waypoints, self._targets = (part.to(env.device) for part in drawn)
        if not env.upper_body.active:
            env.randomizer.set_nominal_gains(slice(env.num_lower, None), self.stance.arm_kp, self.stance.arm_kd)

    def evaluate(self, env: HumanoidEnv, policy: PolicyFunction) -> dict[str, Any]:
        """Run in an environment that is prepared. Returns the measured part of the JSON."""
        obs, act = self._begin(env), acting(env, policy, self.upper_actions)
        scorer = self.scorer(env.num_envs, len(env.spec.joints), env.device)
        film: list[torch.Tensor] = []
        steps = range(self.waypoints * self.segment_steps)
        for step in tqdm(steps, desc="tour", unit="step", disable=None, leave=False):
            self._ask(env, *self.pilot.command(step * env.dt, *_pelvis(env), env.state.heading_w))
            env.motions.place(*arms_at(self._targets, (step + 1) * env.dt))
            obs, _, _, extras = env.step(act(as_dict(obs, env.device)))
            way, turn = self.pilot.error(step // self.segment_steps, *_pelvis(env))
            r = env.record
            scorer.step(env.sim.qpos[:, 2].float(), r.state.joint_vel, r.torque, way, turn, extras["falls"])
            film.append(picture_row(env))
            if not scorer.standing.any():
                break
        measures = scorer.measures()
        self.film = torch.stack(film).cpu()[: round((float(measures.survival_s[0]) + FALL_S) / env.dt)]
        return measures.report(self.segment_s, env.dt, self.seed, self.per_env)

    def _begin(self, env: HumanoidEnv) -> TensorDict:
        """Let all robots go, asked for nothing yet; return the observations."""
        nothing = torch.zeros(env.num_envs, device=env.device)
        self._ask(env, torch.zeros(env.num_envs, 2, device=env.device), nothing, nothing)
        env.motions.place(*arms_at(self._targets, 0.0))
        qpos = self.stance.start().to(env.device).repeat(env.num_envs, 1)
        obs = env.reset((qpos, torch.zeros_like(env.sim.qvel, dtype=qpos.dtype)))
        self.pilot = Pilot(self._waypoints, self.segment_s, env.cfg.commands, *_pelvis(env), self.speed_limit)
        return obs

    @staticmethod
    def _ask(env: HumanoidEnv, velocity: torch.Tensor, yaw_rate: torch.Tensor, stand: torch.Tensor) -> None:
        """Command velocities at nominal height."""
        env.commands.override(velocity, yaw_rate, stand, torch.full_like(yaw_rate, env.spec.nominal_height_m))

    def table(self, result: dict[str, Any]) -> str:
        """The result as Markdown; a whole tour of the G1 beside the published figures."""
        from cotap.evaluation.tour.field import beside_the_field

        return "\n\n".join(filter(None, (report.table(result), beside_the_field(result))))

    def plot(self, path: Path, result: dict[str, Any]) -> None:
        """Share of runs that are upright over time, and the errors at the ends of the segments."""
        plt = report.pyplot()

        figure, (left, right) = plt.subplots(1, 2, figsize=(10.0, 3.6), constrained_layout=True)
        left.plot(result["curve"]["time"], result["curve"]["upright"], color="#2171b5")
        left.set(xlabel="time [s]", ylabel="share of runs upright", ylim=(0.0, 1.02))
        for name, label, color in (
            ("position_error", "position [m]", "#2171b5"),
            ("yaw_error", "yaw [rad]", "#d95f02"),
        ):
            ends = [(s["end_s"], s[name]["mean"]) for s in result["segments"] if s[name]["mean"] is not None]
            right.plot([t for t, _ in ends], [e for _, e in ends], "o-", ms=3, color=color, label=label)
        right.set(xlabel="time [s]", ylabel="error at the segment's end, or at the fall")
        right.legend(frameon=False)
        for axis in (left, right):
            axis.grid(alpha=0.2)
        report.save_figure(figure, path)

    def video(self, path: Path, sheet: Path, env: HumanoidEnv) -> None:
        """Write a video of the first run, with its waypoints and punches, and a contact sheet."""
        from cotap.evaluation.render import STRIDE, film_video
        from cotap.evaluation.tour.film import TourMarks

        waypoints, _ = self.draw(env.spec, self.stance, range(1))
        punches = Punches(env.cfg.forces.punches, len(env.spec.joints), 1, env.dt)
        marks = TourMarks(env.spec, waypoints[0], self.segment_s, punches, STRIDE * env.dt)
        film_video(path, env, self.film, sheet, marks)


def _pelvis(env: HumanoidEnv) -> tuple[torch.Tensor, torch.Tensor]:
    """Where bases are: (N, 2) [m] and yaw (N,) [rad]."""
    return env.sim.qpos[:, :2].float(), yaw_of(env.state.base_rotation_w)
