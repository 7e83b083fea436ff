"""The environment: the order of a step, and nothing else. Every part lives in a module of its own."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any, cast

# MuJoCo's extension module has no type stubs.
# pyright: reportAttributeAccessIssue=false
import mujoco
import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from cotap.checks import (
    require_all_finite,
    require_one_of,
    require_positive_int,
    require_range,
    require_seed,
    require_shape,
)
from cotap.compliance.kinematics import ChainPose
from cotap.compliance.laws import LawConfig
from cotap.envs.actions import ActionConfig, JointTargets
from cotap.envs.blows import BlowConfig, Blows
from cotap.envs.commands import CommandConfig, CommandSource, leaning
from cotap.envs.disturbances import Assistance, AssistConfig, HandForceConfig, HandForces, assist_wrench
from cotap.envs.forces import ForceProfile, ScriptedForces
from cotap.envs.foresight import Foresight
from cotap.envs.gait import desired_contact, swing_progress
from cotap.envs.impedance import ImpedanceConfig, PathFollower
from cotap.envs.load_sense import LoadSense, load_tilt
from cotap.envs.observations import (
    GOALS_PER_ARM,
    ObservationConfig,
    ObservationHistory,
    actor_terms,
    actor_values,
    critic_terms,
    noise_amplitude,
)
from cotap.envs.persistence import on_processor, restored, uniform
from cotap.envs.punches import PunchConfig, Punches
from cotap.envs.randomization import RandomizationConfig, Randomizer
from cotap.envs.reference import ReferenceConfig, ReferenceMotion
from cotap.envs.retries import Retries, RetryConfig, take_over
from cotap.envs.rewards import LowerRewards, RewardGroup, StepRecord, UpperRewards, check_weights
from cotap.envs.state import RobotState, StateReader
from cotap.envs.step_timing import StepTiming
from cotap.envs.symmetry import actor_reflection, critic_reflection, joint_reflection
from cotap.envs.terminations import TerminationConfig, diverged, fallen
from cotap.envs.upper_body import UpperBody, UpperBodyConfig
from cotap.reflection import Symmetry
from cotap.robots import ROBOTS
from cotap.robots.ground import HALF_EXTENT_M
from cotap.robots.mjcf import COLLISIONS, FIXED_BASE_LIFT_M, build_model
from cotap.rotations import quat_about_z, quat_from_matrix, rotate
from cotap.sim import DelayedTargets, Snapshot, make_simulation, resolve_backend

GRAVITY = 9.81


@dataclass
class RewardConfig:
    """Weights of both agents' rewards."""

    lower: LowerRewards = field(default_factory=LowerRewards)
    upper: UpperRewards = field(default_factory=UpperRewards)


@dataclass
class H1EnvConfig:
    """Everything that defines the environment."""

    robot: str = "h1"
    """Name of the robot."""
    num_envs: int = 2048
    """Number of worlds."""
    seed: int = 0
    """Seed of the environment's own random numbers."""
    backend: str = "auto"
    """What simulates: mjbatch (the processor), warp (MuJoCo Warp; a graphics card if there is one), or auto: warp where
    there are a graphics card and the extra `warp`, else mjbatch."""
    num_threads: int = 0
    """Physics threads of mjbatch; 0 takes every processor."""
    collision: str = "feet"
    """feet (only feet meet the floor) or full."""
    control_dt: float = 0.02
    """Control step [s]."""
    substeps: int = 2
    """Physics steps per control step."""
    torque_limit_scale: float = 1.0
    """Factor on the robot's torque limits."""
    fixed_base: bool = False
    """Hold the base in the air: for measurements on the arms alone."""
    unevenness_m: float = 0.0
    """Height of the ground's bumps from lowest to highest [m]; 0 is flat. Worlds start at different places on it
    unless their base is held."""
    actions: ActionConfig = field(default_factory=ActionConfig)
    upper_body: UpperBodyConfig = field(default_factory=UpperBodyConfig)
    observations: ObservationConfig = field(default_factory=ObservationConfig)
    commands: CommandConfig = field(default_factory=CommandConfig)
    motions: ReferenceConfig = field(default_factory=ReferenceConfig)
    impedance: ImpedanceConfig = field(default_factory=ImpedanceConfig)
    rewards: RewardConfig = field(default_factory=RewardConfig)
    terminations: TerminationConfig = field(default_factory=TerminationConfig)
    randomization: RandomizationConfig = field(default_factory=RandomizationConfig)
    hand_forces: HandForceConfig = field(default_factory=HandForceConfig)
    blows: BlowConfig = field(default_factory=BlowConfig)
    force: ForceProfile = field(default_factory=ForceProfile)
    punches: PunchConfig = field(default_factory=PunchConfig)
    assist: AssistConfig = field(default_factory=AssistConfig)
    retries: RetryConfig = field(default_factory=RetryConfig)

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_positive_int("num_envs", self.num_envs)
        require_positive_int("substeps", self.substeps)
        require_seed("seed", self.seed)
        require_one_of("robot", self.robot, ROBOTS.keys())
        resolve_backend(self.backend)
        require_one_of("collision", self.collision, COLLISIONS)
        require_range("control_dt", self.control_dt, 1e-4, 1.0)
        require_range("torque_limit_scale", self.torque_limit_scale, 1e-3, 1e3)
        require_range("unevenness_m", self.unevenness_m, 0.0, 0.2)
        for part in (
            self.actions, self.upper_body, self.observations, self.commands, self.motions, self.impedance,
            self.terminations, self.hand_forces, self.blows, self.force, self.punches, self.assist,
            self.retries,
        ):  # fmt: skip
            part.check()
        self.randomization.check(self.control_dt)
        check_weights("lower", self.rewards.lower)
        check_weights("upper", self.rewards.upper)


class H1Env(VecEnv):
    """N robots that walk with their legs and follow a reference with their arms.

    One step, in order: reference motion advances, actions to targets; physics, forces held and targets arriving late;
    state read once; clocks of commands and forces advance; falls, divergence and time-outs found; rewards from the
    record of the step; ended worlds restart; observations. After a step, everything in an observation is current;
    foot sensors (rewards only) lag one physics step.

    `action_slices` and `reward_groups` tell agents, by name, which actions and which reward are theirs; `step` returns
    the sum of the groups' rewards, and each group's in `extras["group_rewards"]` (N, groups).

    Args:
        cfg: What defines it.
        processes: How many learn as one, each with as many worlds: `samples`, and what fades with them, counts all.

    Raises:
        ValueError: a field of the config is out of its range.
    """

    cfg: H1EnvConfig  # pyright: ignore[reportIncompatibleVariableOverride]
    reward_groups = ("lower", "upper")

    def __init__(self, cfg: H1EnvConfig | None = None, processes: int = 1) -> None:
        self.cfg = cfg = cfg or H1EnvConfig()
        cfg.check()
        self._worlds_in_all = cfg.num_envs * require_positive_int("processes", processes)
        self.num_envs = cfg.num_envs
        self.spec = spec = ROBOTS[cfg.robot]()
        self.num_actions = len(spec.joints)
        self.num_lower = len(spec.lower_joints)
        self.action_slices = {"lower": slice(0, self.num_lower), "upper": slice(self.num_lower, self.num_actions)}
        model = build_model(spec, cfg.collision, cfg.control_dt / cfg.substeps, cfg.fixed_base, cfg.unevenness_m)
        model.actuator_forcerange[:] *= cfg.torque_limit_scale
        self.sim = make_simulation(cfg.backend, model, self.num_envs, cfg.substeps, cfg.num_threads, Randomizer.FIELDS)
        self.device = self.sim.device
        self.dt = self.sim.dt
        self.max_episode_length = math.ceil(cfg.terminations.episode_s / self.dt)
        self.rng = torch.Generator(self.device).manual_seed(cfg.seed)
        with torch.device(self.device):  # where every part makes its tensors
            self._assemble(model)
        self.reset()

    def _assemble(self, model: mujoco.MjModel) -> None:
        """Make all parts and their tensors."""
        cfg, spec, n = self.cfg, self.spec, self.num_envs
        joints = spec.joints
        self._default = torch.tensor([j.default_rad for j in joints])
        self._torque_limit = cfg.torque_limit_scale * torch.tensor([j.torque_limit_nm for j in joints])
        low, high = torch.tensor([j.range_rad for j in joints]).unbind(1)
        center, half = (low + high) / 2, 0.95 * (high - low) / 2
        self._soft_limits = (center - half, center + half)
        self._sideways = tuple(
            i for i, j in enumerate(joints[: self.num_lower]) if j.mirror_sign < 0.0
        )  # yaw and roll joints
        self.joint_targets = JointTargets(cfg.actions, spec, model, cfg.commands)

        self.reader = StateReader(spec, self.sim)
        self.arm_limits = self.reader.arm_joints(self._torque_limit.unsqueeze(0))[0]
        self._hand_bodies = [model.body(arm.hand_body).id for arm in spec.arms]
        arm_links = [b for arm in spec.arms for b in spec.chain(arm.hand_body, spec.torso_body)]
        self._arm_bodies = [model.body(link.name).id for link in arm_links]
        self._arm_coms = torch.tensor([link.com for link in arm_links])
        self._hand_lever = torch.stack(
            [torch.tensor(a.hand_point) - torch.tensor(spec.body(a.hand_body).com) for a in spec.arms]
        )
        self._elbow_joints = [
            [b.name for b in spec.chain(a.hand_body, spec.torso_body)].index(a.elbow_body) for a in spec.arms
        ]
        self._base_body = model.body(spec.base_body).id
        self.weight_n = float(model.body_mass.sum()) * GRAVITY
        """Of the nominal robot [N]."""

        self.commands = CommandSource(cfg.commands, n, spec.nominal_height_m, self.dt)
        self.foresight = Foresight(spec) if cfg.commands.foresee_falls else None
        self.load_sense = (
            LoadSense(spec, n, self.dt, cfg.commands.brace_tilt_rad) if cfg.commands.lean_into_loads else None
        )
        self.step_timing = (
            StepTiming(spec, n, self.dt, cfg.commands.step_correct_s) if cfg.commands.step_timing else None
        )
        self.motions = ReferenceMotion(cfg.motions, spec, n, self.dt)
        self.path = PathFollower(cfg.impedance, n, self.dt)
        usual_hands_h = self.reader.arm_chains.pose(self.reader.arm_joints(self._default.unsqueeze(0))).tip[0]
        self.hand_forces = HandForces(cfg.hand_forces, usual_hands_h, n, self.dt)
        self.blows = Blows(cfg.blows, n, len(spec.arms), self.dt)
        self.scripted = ScriptedForces(cfg.force, tuple(arm.side for arm in spec.arms), n, self.dt)
        self.punches = Punches(cfg.punches, n, self.num_actions - self.num_lower, self.dt)
        self.assistance = Assistance(cfg.assist, self._worlds_in_all, self.dt)
        self.retries = Retries(cfg.retries, n, self.dt) if cfg.retries.share > 0.0 else None
        self.randomizer = Randomizer(cfg.randomization, spec, self.sim)
        self.upper_body = UpperBody(cfg.upper_body, spec, n, self.dt)
        self.targets = DelayedTargets(n, self.num_actions, cfg.substeps, self.dt)
        num_upper, sees = self.num_actions - self.num_lower, cfg.observations.arm_torque == "actor"
        goals = GOALS_PER_ARM * len(spec.arms) * cfg.observations.goals
        terms = actor_terms(self.num_actions, num_upper, sees, goals)
        self._critic_terms = critic_terms(len(spec.arms), 0 if sees else num_upper)
        self.history = ObservationHistory(terms, n, cfg.observations.history)
        self._clean_history = ObservationHistory(terms, n, cfg.observations.history)
        self._noise = noise_amplitude(terms, cfg.observations.noise)
        self._critic_scale = torch.cat([torch.full((w,), s) for _, w, s in self._critic_terms])
        self._groups = (
            RewardGroup("lower", cfg.rewards.lower, self.dt),
            RewardGroup("upper", cfg.rewards.upper, self.dt),
        )

        self._everyone = torch.ones(n, dtype=torch.bool)
        self.samples = 0
        self.num_diverged = 0
        self.episode_length_buf = torch.zeros(n, dtype=torch.long)
        self._last_action = torch.zeros(n, self.num_actions)
        self._mean_error = torch.zeros(n, 3)
        self._hand_force_w = torch.zeros(n, len(spec.arms), 3)
        self._arm_effort = torch.zeros(n, self.num_actions - self.num_lower)
        self._kp, self._kd = self.randomizer.gains()
        self.randomizer.randomize_bodies(self.rng)
        self.state: RobotState

    @property
    def obs_groups(self) -> dict[str, list[str]]:
        """Which observation groups actors and critics read (rsl_rl's `obs_groups`)."""
        noisy = self.cfg.observations.noise.enabled
        return {"actor": ["policy"], "critic": ["clean" if noisy else "policy", "privileged"]}

    @property
    def hand_force_w(self) -> torch.Tensor:
        """(N, H, 3) force at each hand in the last step, world frame [N]."""
        return self._hand_force_w

    @property
    def symmetry(self) -> Symmetry:
        """The mirror images of observations and actions."""
        terms, steps = self.history.terms, self.history.steps
        actor = actor_reflection(self.spec, terms, steps)
        critic = critic_reflection(self.spec, self._critic_terms)
        return Symmetry(
            {"policy": actor, "clean": actor, "privileged": critic}, joint_reflection(self.spec, self.spec.joint_names)
        )

    def layout(self) -> dict[str, Any]:
        """What a policy must agree with: robot, joints, observation terms, action convention."""
        c = self.cfg
        actions = asdict(c.actions)
        # How far ahead the arms' targets run is theirs, and no part of what an action means.
        del actions["reference_lead_s"]
        return {
            "robot": self.spec.name,
            "joints": list(self.spec.joint_names),
            "terms": [list(t) for t in self.history.terms],
            "history": self.history.steps,
            "critic_terms": [list(t) for t in self._critic_terms],
            "actions": actions,
            "control_dt": c.control_dt,
        }

    def reset(self) -> TensorDict:
        """Restart every world and return the observations."""
        self._restart(self._everyone)
        self._observe(self._everyone)
        if self.retries:
            self.retries.load_state_dict({})  # nobody goes back beyond this
        return self._observations

    def reset_alike(self, seed: int) -> TensorDict:
        """Restart every world with the same random numbers, so that all start in one state; return the observations."""
        require_seed("seed", seed)
        for world in range(self.num_envs):
            self.rng.manual_seed(seed)
            self._restart(torch.arange(self.num_envs, device=self.device) == world)
        self._observe(self._everyone)
        return self._observations

    def get_observations(self) -> TensorDict:
        """The present observations: `policy` (N, 430), `privileged` (N, 13), and `clean` where sensors are noisy."""
        return self._observations

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advance by one control step.

        Args:
            actions: (N, J).

        Returns:
            Observations, rewards (N,), dones (N,), extras with `time_outs` (N,), `falls` (N,), `group_rewards`
            (N, groups), `log`.

        Raises:
            ValueError: actions have another shape or are not finite.
        """
        require_shape("actions", actions, (self.num_envs, self.num_actions))
        require_all_finite("actions", actions)
        action = actions.clamp(-self.cfg.actions.clip, self.cfg.actions.clip)
        # The reference moves first: arms are sent where it will be, and judged against that, at the end of the step.
        self.motions.step(self.rng)
        self.targets.send(self.target_from_action(action))
        self._send_to_arms()
        velocity_before = self.state.joint_vel
        self._apply_forces()
        self.sim.step(self._drive)

        bad = diverged(self.sim.qpos, self.sim.qvel)
        self.state = self.reader.read()
        self.samples += self._worlds_in_all
        self.episode_length_buf += 1
        s = self.state
        turning = s.torso_angular_velocity_t
        timing, command = self.step_timing, self.commands.current()
        if self.load_sense:
            self.load_sense.step(s, command, self.joint_torque(s))
        felt = self.felt
        lean = leaning(felt.projected_gravity_t, turning)
        if self.foresight:
            lean = self.foresight.lean(lean, felt, command)
        catch = timing.step(felt, command, lean > self.commands.cfg.steady_rad) if timing else None
        braces = self.load_sense.braces if self.load_sense else None
        self.commands.step(self.rng, lean, turning[:, 2], catch, braces)
        self._follow_path()
        if self.upper_body.active:
            self.upper_body.sense(s, self._hand_force_w, self._arm_effort)
        self.upper_body.step(self.dt, self.rng)
        self.hand_forces.step(self.rng)
        self.punches.step(self.rng)

        fell = fallen(self.cfg.terminations, self.state.height, self.state.projected_gravity_t) | bad
        self.assistance.step(fell, self.samples)
        thrown = fell & self.blows.recovering()
        self.blows.step(fell, self.assistance.share(self.samples) == 0.0, self.rng)
        time_out = (self.episode_length_buf >= self.max_episode_length) & ~fell
        record = self._record(action, velocity_before, fell)
        self.record = record
        num_bad = int(bad.sum())
        self.num_diverged += num_bad
        ok = ~bad if num_bad else slice(None)  # picking all of the worlds by a mask would copy them
        rewards, log = self._reward(record, bad, ok)
        self._last_action = action.clone()  # the record keeps its own: restarts clear this one
        done = fell | time_out
        log.update(self._log(record, fell, time_out, ok))
        if done.any():
            self._finish(done, fell & ~thrown)
            self._restart(done)
        self._observe(done)
        if self.retries:
            self._try_again(self.retries, fell, done)
        extras = {"time_outs": time_out, "falls": fell, "group_rewards": rewards, "log": log}
        return self._observations, rewards.sum(1), done, extras

    def _try_again(self, retries: Retries, fell: torch.Tensor, done: torch.Tensor) -> None:
        """Take some of the worlds that fell back to where they were before; what they learn of loads by falling, the
        curriculum, is not taken back."""
        ids, past = retries.draw(fell, done, self.rng)
        if len(ids):
            shares = self.hand_forces.scale, self.blows.scale
            state = self._worlds()
            take_over(state, past, ids, self.num_envs)
            self._load_worlds(state)
            self.hand_forces.scale, self.blows.scale = shares
        if retries.due():
            retries.keep(self._worlds())

    def _follow_path(self) -> None:
        """Where the torso is led along a path, that sets the velocity command."""
        if self.cfg.impedance.share == 0.0:
            return
        s = self.state
        velocity, yaw_rate = self.path.step(s.torso_pos_w[:, :2], s.heading_w, self.motions.root_velocity())
        self.commands.set_velocity(velocity, yaw_rate, self.path.active)

    @property
    def felt(self) -> RobotState:
        """The state as the robot feels it: with the vertical that the loads on it ask for, if it senses loads."""
        return self.load_sense.felt(self.state) if self.load_sense else self.state

    def target_from_action(self, action: torch.Tensor) -> torch.Tensor:
        """Joint targets (N, J) [rad] of actions (N, J), for the present command, gait phase and arm reference."""
        s, reference = self.felt, self.motions.current()
        return self.joint_targets(
            action, self.commands.current(), s.joint_pos, s.joint_vel, s.projected_gravity_t,
            s.torso_angular_velocity_t, reference.position + self.cfg.actions.reference_lead_s * reference.velocity,
        )  # fmt: skip

    def set_law(self, world: int, arm: int, law: LawConfig) -> None:
        """Put one arm of one world under another law, from the next step on. Raises ValueError as `law.check` does."""
        ruled = self.upper_body.active
        self.upper_body.set_law(world, arm, law)
        if ruled and not self.upper_body.active:  # actuators are the arms' own PD again
            self.randomizer.write_gains(self._everyone)
            self._kp, self._kd = self.randomizer.gains()

    def arm_stiffness(self) -> torch.Tensor:
        """Joint stiffness of the arms under the laws in force, (N, A, n, n) [Nm/rad]."""
        if self.upper_body.active:
            return self.upper_body.stiffness
        return torch.diag_embed(self.reader.arm_joints(self._kp))

    def state_dict(self) -> dict[str, Any]:
        """All that the environment's future depends on, on the processor whatever the device."""
        state = self._worlds() | {
            "counters": {"samples": self.samples, "num_diverged": self.num_diverged},
            "rng": self.rng.get_state(),
        }
        return on_processor(state | ({"retries": self.retries.state_dict()} if self.retries else {}))

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on exactly where `state_dict` was taken; on another kind of device or with another backend, with its own
        arithmetic and random numbers. Raises ValueError for another number of worlds."""
        self._load_worlds(state)
        self.samples = state["counters"]["samples"]
        self.num_diverged = state["counters"]["num_diverged"]
        if state["rng"].shape == self.rng.get_state().shape:
            self.rng.set_state(state["rng"].cpu())
        if self.retries:
            self.retries.load_state_dict(state.get("retries", {}))

    def _worlds(self) -> dict[str, Any]:
        """What all worlds are in: copies, with worlds first, but for what they share."""
        snapshot = self.sim.snapshot()
        return {
            "sim": {"state": snapshot.state, "sensors": snapshot.sensors, "fields": snapshot.fields},
            "parts": {name: part.state_dict() for name, part in self._parts().items()},
            "delay": {
                "delay_s": self.targets.delay_s.clone(),
                "previous": self.targets.previous.clone(),
                "current": self.targets.current.clone(),
            },
            "episode_length": self.episode_length_buf.clone(),
            "last_action": self._last_action.clone(),
            "mean_error": self._mean_error.clone(),
            "observations": {k: cast(torch.Tensor, v).clone() for k, v in self._observations.items()},
        }

    def _load_worlds(self, state: dict[str, Any]) -> None:
        """Take over what `_worlds` returned."""
        self.sim.restore(Snapshot(**state["sim"]))
        # Where the clock could not jump before, it has not jumped; loads that were not sensed were none.
        new = {"step_timing", "load_sense"} - state["parts"].keys()
        for name, part in self._parts().items():
            if name not in new:
                part.load_state_dict(state["parts"][name])
        for name in ("delay_s", "previous", "current"):
            setattr(self.targets, name, restored(f"delay.{name}", state["delay"][name], getattr(self.targets, name)))
        self._kp, self._kd = self.randomizer.gains()
        self.episode_length_buf = restored("episode_length", state["episode_length"], self.episode_length_buf)
        self._last_action = restored("last_action", state["last_action"], self._last_action)
        self._mean_error = restored("mean_error", state["mean_error"], self._mean_error)
        present = {k: cast(torch.Tensor, v) for k, v in self._observations.items()}
        saved = {k: restored(f"observations.{k}", state["observations"][k], v) for k, v in present.items()}
        self._observations = TensorDict(saved, batch_size=[self.num_envs])
        self.state = self.reader.read()

    def progress(self) -> dict[str, float]:
        """How far has come what fades or grows with success, whatever the number of worlds: shares in [0, 1]."""
        return {
            "assistance": self.assistance.left,
            "hand_forces": float(self.hand_forces.scale.mean()),
            "blows": float(self.blows.scale.mean()),
        }

    def load_progress(self, progress: dict[str, float]) -> None:
        """Let all worlds go on from what `progress` returned. Raises ValueError for anything else."""
        if progress.keys() != self.progress().keys():
            raise ValueError(f"progress must be of {', '.join(self.progress())}, got {', '.join(map(str, progress))}")
        for name, share in progress.items():
            require_range(f"progress of {name}", share, 0.0, 1.0)
        self.assistance.left = progress["assistance"]
        for name, part in (("hand_forces", self.hand_forces), ("blows", self.blows)):
            part.scale = torch.full_like(part.scale, progress[name])

    def keep_in_step(self, mean: Callable[[torch.Tensor], torch.Tensor]) -> None:
        """Replace what all worlds share, and learn from their falls, by its mean over processes."""
        self.assistance.keep_in_step(mean)

    def _parts(self) -> dict[str, Any]:
        return {
            "commands": self.commands,
            "motions": self.motions,
            "path": self.path,
            "upper_body": self.upper_body,
            "hand_forces": self.hand_forces,
            "blows": self.blows,
            "scripted": self.scripted,
            "punches": self.punches,
            "assistance": self.assistance,
            "randomizer": self.randomizer,
            "history": self.history,
            "clean_history": self._clean_history,
            **({"step_timing": self.step_timing} if self.step_timing else {}),
            **({"load_sense": self.load_sense} if self.load_sense else {}),
        }

    def _send_to_arms(self) -> None:
        """Ask the arms' laws for this control step, and let the simulator integrate the stiffness' diagonal."""
        if not self.upper_body.active:
            return
        arms = slice(self.num_lower, None)
        self._arm_effort.zero_()
        self.upper_body.send(self.state, self.targets.current[:, arms], self.motions.current().velocity)
        kp, kd = self.upper_body.implicit_gains()
        self._kp[:, arms], self._kd[:, arms] = kp, kd
        bias = self.sim.field("actuator_biasprm")
        bias[:, arms, 1], bias[:, arms, 2] = -kp.double(), -kd.double()

    def _drive(self, substep: int) -> torch.Tensor:
        """What actuators are given, which subtract `kp q + kd dq` themselves: PD, and the arms' laws on top."""
        control = self._kp * self.targets.at(substep)
        if self.upper_body.active:
            arms = slice(self.num_lower, None)
            q = self.sim.qpos[:, 7 + self.num_lower :].float()
            dq = self.sim.qvel[:, 6 + self.num_lower :].float()
            torque = self._arm_torque(q, dq, self.targets.arrived(substep))
            limit = self._torque_limit[arms]
            self._arm_effort += torque.clamp(-limit, limit) / self.cfg.substeps
            control[:, arms] = torque + self._kp[:, arms] * q + self._kd[:, arms] * dq
        return control

    def _arm_torque(self, q: torch.Tensor, dq: torch.Tensor, arrived: torch.Tensor) -> torch.Tensor:
        """Torque (N, U) that the arms' laws ask for, gains as randomised."""
        arms = slice(self.num_lower, None)
        scales = self.randomizer.kp_scale[:, arms], self.randomizer.kd_scale[:, arms]
        return self.upper_body.torque(q, dq, arrived, *scales)

    def _apply_forces(self) -> None:
        s = self.state
        to_heading = s.heading_w.transpose(1, 2) @ s.torso_rotation_w
        jacobian_h = to_heading.unsqueeze(1) @ self.reader.arm_chains.jacobian(s.arms)
        force_h = self.hand_forces.current(jacobian_h, self.arm_limits)
        if self.cfg.blows.enabled:
            force_h = force_h + self.blows.current()
        if self.scripted.active:
            scripted_h = self.scripted.at(self.dt * self.episode_length_buf)
            force_h = force_h + scripted_h[:, :-1]
            self.sim.xfrc[:, self._base_body, :3] = rotate(s.heading_w, scripted_h[:, -1]).double()
        self._hand_force_w = (s.heading_w.unsqueeze(1) @ force_h.unsqueeze(-1)).squeeze(-1)
        hand_rotation_w = s.torso_rotation_w.unsqueeze(1) @ s.arms.rotation
        lever_w = rotate(hand_rotation_w, self._hand_lever)
        for i, body in enumerate(self._hand_bodies):
            self.sim.apply_force(body, self._hand_force_w[:, i], lever_w[:, i])
        if self.punches.active:
            self._punch()
        share = self.assistance.share(self.samples)
        if self.cfg.assist.enabled:
            command = self.commands.current()
            error_h = torch.nn.functional.pad(command.velocity_h - s.torso_linear_velocity_h[:, :2], (0, 1))
            force, torque = assist_wrench(
                self.cfg.assist, self.weight_n, s.torso_rotation_w[:, :, 2],
                rotate(s.torso_rotation_w, s.torso_angular_velocity_t), rotate(s.heading_w, error_h)[:, :2],
                command.yaw_rate - s.yaw_rate, command.height - s.height, s.torso_linear_velocity_h[:, 2],
            )  # fmt: skip
            wrench = share * torch.cat((force, torque), 1).double()
            if self.scripted.active:
                wrench[:, :3] += self.sim.xfrc[:, self._base_body, :3]
            self.sim.xfrc[:, self._base_body] = wrench

    def _punch(self) -> None:
        """Add the blows on the arms' joints to what acts on the links already."""
        s = self.state
        rotations_w = (s.torso_rotation_w[:, None, None] @ s.arms.rotations).flatten(1, 2)
        blows_w = self.punches.current()
        for i, body in enumerate(self._arm_bodies):
            # The joint is the origin of the link's frame.
            lever_w = -rotate(rotations_w[:, i], self._arm_coms[i])
            wrench = torch.cat((blows_w[:, i], torch.linalg.cross(lever_w, blows_w[:, i])), 1).double()
            self.sim.xfrc[:, body] = wrench + (self.sim.xfrc[:, body] if body in self._hand_bodies else 0.0)

    def _record(self, action: torch.Tensor, velocity_before: torch.Tensor, fell: torch.Tensor) -> StepRecord:
        s, command, reference = self.state, self.commands.current(), self.motions.current()
        num_feet = len(self.spec.feet)
        arms_reference = self.reader.arm_chains.pose(reference.position.unflatten(1, (len(self.spec.arms), -1)))
        points, velocities = self._key_points(s.arms, self.reader.arm_joints(s.joint_vel))
        ref_points, ref_velocities = self._key_points(
            arms_reference, reference.velocity.unflatten(1, (len(self.spec.arms), -1))
        )
        return StepRecord(
            state=s,
            command=command,
            load_tilt=self._load_tilt(),
            reference=reference,
            action=action,
            last_action=self._last_action,
            joint_acceleration=(s.joint_vel - velocity_before) / self.dt,
            torque=self.joint_torque(s),
            arm_target=self.targets.current[:, self.num_lower :],
            desired_contact=desired_contact(command.phase, command.stand, num_feet),
            swing=swing_progress(command.phase, num_feet),
            key_points_t=points,
            key_points_reference_t=ref_points,
            key_velocities_t=velocities,
            key_velocities_reference_t=ref_velocities,
            mean_error=self._average_error(),
            fell=fell,
            joint_low=self._soft_limits[0],
            joint_high=self._soft_limits[1],
            num_lower=self.num_lower,
            default_position=self._default,
            sideways=self._sideways,
        )

    def _load_tilt(self) -> torch.Tensor:
        """By how much the loads on its hands tilt the vertical of a robot that leans against them, (N, 2) [rad]."""
        if not self.load_sense:
            return self.state.torso_pos_w.new_zeros(self.num_envs, 2)
        return load_tilt(self.state, self.state.hand_pos_w, self._hand_force_w, self.weight_n)

    def _average_error(self) -> torch.Tensor:
        """Velocity errors (N, 3), averaged exponentially over half a stride."""
        s, c = self.state, self.commands.current()
        error = torch.cat((s.torso_linear_velocity_h[:, :2] - c.velocity_h, (s.yaw_rate - c.yaw_rate).unsqueeze(1)), 1)
        # A world that has diverged is about to restart; its error must not outlast it.
        error = torch.nan_to_num(error, 0.0, 0.0, 0.0).clamp(-10.0, 10.0)
        share = 2.0 * self.dt / self.cfg.commands.gait_period_s
        self._mean_error = torch.lerp(self._mean_error, error, min(share, 1.0))
        return self._mean_error

    def joint_torque(self, state: RobotState) -> torch.Tensor:
        """Torque (N, J) [Nm] that the law in force gives at `state`."""
        last = self.cfg.substeps - 1
        torque = self._kp * (self.targets.at(last) - state.joint_pos) - self._kd * state.joint_vel
        if self.upper_body.active:
            arms = slice(self.num_lower, None)
            ruled = self._arm_torque(state.joint_pos[:, arms], state.joint_vel[:, arms], self.targets.arrived(last))
            # Worlds that have just restarted have been told nothing yet; they hold their PD targets.
            torque[:, arms] = torch.where(self.upper_body.fresh.unsqueeze(1), torque[:, arms], ruled)
        return torch.clamp(torque, -self._torque_limit, self._torque_limit)

    def _key_points(self, arms: ChainPose, rates: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Hands and elbows (N, 2A, 3) in the torso frame and their velocities there, for joint rates (N, A, n)."""
        elbows = torch.stack([arms.anchors[:, a, j] for a, j in enumerate(self._elbow_joints)], 1)
        spin = arms.axes * rates.unsqueeze(-1)
        hand_velocity = torch.linalg.cross(spin, arms.tip.unsqueeze(2) - arms.anchors).sum(2)
        elbow_velocity = torch.stack(
            [
                torch.linalg.cross(spin[:, a, :j], elbows[:, a, None] - arms.anchors[:, a, :j]).sum(1)
                for a, j in enumerate(self._elbow_joints)
            ],
            1,
        )
        return torch.cat((arms.tip, elbows), 1), torch.cat((hand_velocity, elbow_velocity), 1)

    def _reward(
        self, record: StepRecord, bad: torch.Tensor, ok: torch.Tensor | slice
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        totals: list[torch.Tensor] = []
        log: dict[str, torch.Tensor] = {}
        # A diverged world has no meaningful reward; its episode ends and is counted.
        for group in self._groups:
            total, terms = group(record)
            totals.append(torch.where(bad, 0.0, total))
            means = _mean(terms[:, ok])
            log.update({f"/{group.name}/{name}": mean for name, mean in zip(group.terms, means.unbind(), strict=True)})
        return torch.stack(totals, 1), log

    def _log(
        self, r: StepRecord, fell: torch.Tensor, time_out: torch.Tensor, ok: torch.Tensor | slice
    ) -> dict[str, torch.Tensor]:
        measured = torch.cat((r.state.torso_linear_velocity_h[:, :2], r.state.yaw_rate.unsqueeze(1)), 1)[ok]
        commanded = torch.cat((r.command.velocity_h, r.command.yaw_rate.unsqueeze(1)), 1)[ok]
        slope = (measured * commanded).sum(0) / commanded.square().sum(0).clamp_min(1e-6)
        error = (measured - commanded).abs()
        arm_error = (r.state.joint_pos[:, self.num_lower :] - r.reference.position)[ok].norm(dim=1)
        highest_foot = r.state.foot_pos_w[ok][:, :, 2].amax(1)
        return {
            "/command/error_velocity": _mean((measured - commanded)[:, :2].norm(dim=1)),
            "/command/error_yaw_rate": _mean(error[:, 2]),
            "/command/error_height": _mean((r.state.height - r.command.height)[ok].abs()),
            "/command/slope_x": slope[0],
            "/command/slope_y": slope[1],
            "/command/slope_yaw": slope[2],
            "/command/e_upper": _mean(arm_error),
            "/command/highest_foot": _mean(highest_foot),
            "/episode/falls_per_s": fell.float().mean() / self.dt,
            "/episode/time_outs_per_s": time_out.float().mean() / self.dt,
            "/episode/diverged": torch.tensor(float(self.num_diverged)),
            "/curriculum/hand_force": self.hand_forces.scale.mean(),
            "/curriculum/blow": self.blows.scale.mean(),
            **self._law_log(r),
            "/curriculum/assist": torch.tensor(self.assistance.share(self.samples)),
        }

    def _law_log(self, r: StepRecord) -> dict[str, torch.Tensor]:
        """What the arms' laws report, and the share of arm joints that are at their torque limit."""
        if not self.upper_body.active:
            return {}
        arms = slice(self.num_lower, None)
        at_limit = (r.torque[:, arms].abs() > 0.999 * self._torque_limit[arms]).float().mean()
        return self.upper_body.log | {"/law/saturated": at_limit}

    def _finish(self, done: torch.Tensor, fell: torch.Tensor) -> None:
        if self.assistance.share(self.samples) > 0.0:
            return  # what lasts in a gantry proves nothing
        long_enough = self.episode_length_buf >= 0.75 * self.max_episode_length
        self.hand_forces.finish_episodes(done & long_enough, done & fell & ~long_enough)

    def _restart(self, mask: torch.Tensor) -> None:
        """Put the worlds of `mask` on their feet, nearly at rest: default legs with noise, arms on their reference."""
        n = int(mask.sum())
        self.randomizer.randomize_episode(mask, self.targets.delay_s, self.rng)
        self._kp, self._kd = self.randomizer.gains()
        self.commands.reset(mask, self.rng)
        if self.step_timing:
            self.step_timing.reset(mask)
        if self.load_sense:
            self.load_sense.reset(mask)
        self.motions.reset(mask, self.rng)
        self.upper_body.reset(mask, self.rng)
        self.hand_forces.reset(mask, self.rng)
        self.blows.reset(mask, self.rng)
        self.scripted.reset(mask, self.rng)
        self.punches.reset(mask, self.rng)
        joints = self._default + uniform(self.rng, -0.05, 0.05, n, self.num_actions)
        joints[:, self.num_lower :] = self.motions.current().position[mask]
        position = torch.zeros(n, 3, device=self.device)
        position[:, 2] = self.spec.nominal_height_m + (FIXED_BASE_LIFT_M if self.cfg.fixed_base else 0.01)
        if self.cfg.unevenness_m > 0.0 and not self.cfg.fixed_base:
            position[:, :2] = uniform(self.rng, -0.5 * HALF_EXTENT_M, 0.5 * HALF_EXTENT_M, n, 2)
            position[:, 2] += 0.5 * self.cfg.unevenness_m
        yaw = uniform(self.rng, -math.pi, math.pi, n) * (not self.cfg.fixed_base)
        qpos = torch.cat((position, quat_about_z(yaw), joints), 1)
        qvel = torch.cat((uniform(self.rng, -0.05, 0.05, n, 6), torch.zeros_like(joints)), 1)
        self.sim.reset(mask, qpos, qvel)
        self.targets.reset(mask, joints)
        self._last_action[mask] = 0.0
        self._mean_error[mask] = 0.0
        self._hand_force_w[mask] = 0.0
        self.episode_length_buf[mask] = 0
        if n == self.num_envs:
            self.state = self.reader.read()
        else:
            ids = mask.nonzero().squeeze(1)
            self.state = self.state.with_worlds(ids, self.reader.read(ids))
        self.path.reset(mask, self.state.torso_pos_w[:, :2], self.state.heading_w, self.rng)

    def _observe(self, restarted: torch.Tensor) -> None:
        """Append the present to the history of every world and assemble the observation groups."""
        s, seen = self.state, self.cfg.observations
        torque = self.joint_torque(s)[:, self.num_lower :]
        values = actor_values(
            self.felt, self.commands.current(), self.motions.current().position, self._default, self._last_action,
            torque,
        )  # fmt: skip
        present = self.history.scaled(values | ({"goals": self._goals()} if seen.goals else {}))
        unseen = None if seen.arm_torque == "actor" else torque
        groups = {"privileged": self._privileged(s, unseen) * self._critic_scale}
        if self.cfg.observations.noise.enabled:
            groups["clean"] = self._clean_history.append(present, restarted)
            present = present + self._noise * uniform(self.rng, -1.0, 1.0, *present.shape)
        groups["policy"] = self.history.append(present, restarted)
        self._observations = TensorDict(groups, batch_size=[self.num_envs])

    def _goals(self) -> torch.Tensor:
        """What the arms' laws are asked for, (N, 5 A), of the order of one."""
        p = self.upper_body.parameters
        stiffness, null = (p.stiffness / 300.0).log(), (p.null_stiffness / 40.0).log()
        return torch.cat((stiffness, null.unsqueeze(2), p.alpha.unsqueeze(2)), 2).flatten(1)

    def _privileged(self, s: RobotState, torque: torch.Tensor | None) -> torch.Tensor:
        """What only critics see; with arm torque (N, U) where actors do not."""
        return torch.cat(
            (
                quat_from_matrix(s.torso_rotation_w), s.torso_linear_velocity_h,
                *(() if torque is None else (torque,)), self._hand_force_w.flatten(1),
            ),
            1,
        )  # fmt: skip


def _mean(values: torch.Tensor) -> torch.Tensor:
    """Means over the last dimension of `values` (..., n); 0 if there are none, as when all worlds have diverged."""
    return values.sum(-1) / max(values.shape[-1], 1)
