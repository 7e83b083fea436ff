"""The environment: the order of a step, and nothing else. Every part lives in a module of its own."""

from __future__ import annotations

import json
import math
from typing import Any, cast

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from cotap.checks import quoted, require_all_finite, require_positive_int, require_seed, require_shape
from cotap.compliance.laws import LawConfig
from cotap.envs.actions import JointTargets
from cotap.envs.actuation import Actuation
from cotap.envs.commands import CommandSource
from cotap.envs.config import HumanoidEnvConfig
from cotap.envs.curriculum import AssistWrench, Curriculum
from cotap.envs.external_forces import ExternalForces
from cotap.envs.observer import Observer
from cotap.envs.path_following import PathFollower
from cotap.envs.randomization import Randomizer
from cotap.envs.record import Recorder, step_log
from cotap.envs.rewards import RewardGroup, StepRecord
from cotap.envs.saved_state import env_state, restore_env
from cotap.envs.start import start_state
from cotap.envs.state import RobotState, StateReader
from cotap.envs.terminations import diverged, fallen
from cotap.envs.upper_body import UpperBody
from cotap.memory import require_memory
from cotap.motions.reference import ReferenceMotion
from cotap.reflection import Symmetry
from cotap.robots import ROBOTS
from cotap.robots.mjcf import build_model, torso_inertia
from cotap.sim import make_simulation, simulated_on

BYTES_PER_JOINT = 1100
"""Memory that an env takes for each joint of its robot: measured on mjbatch, without contacts, so that it is never
less."""


class HumanoidEnv(VecEnv):
    """N robots that walk with their legs and follow a reference with their arms.

    One step, in order: reference motion advances, actions become targets, arms' laws are asked, forces are set;
    physics; state read once; commands and forces advance; falls, divergence and time-outs found; rewards from the
    record of the step; ended envs restart; observations. After a step, everything in an observation is current; foot
    sensors (rewards and critics only) lag one physics step.

    `action_slices` and `reward_groups` name the agents alike, in one order: which actions and which column of rewards
    are theirs. `step` returns the sum of the groups' rewards, and each group's in `extras["group_rewards"]` (N,
    groups).

    Args:
        cfg: What defines it.
        processes: How many learn as one, each with as many envs: `samples`, and what follows them, counts all.

    Raises:
        ValueError: a field of the config is out of its range, or there is no memory for so many envs.
    """

    cfg: HumanoidEnvConfig  # pyright: ignore[reportIncompatibleVariableOverride]
    reward_groups = ("lower", "upper")

    def __init__(self, cfg: HumanoidEnvConfig | None = None, processes: int = 1) -> None:
        self.cfg = cfg = cfg or HumanoidEnvConfig()
        cfg.check()
        self._total_envs = cfg.num_envs * require_positive_int("processes", processes)
        self.num_envs = cfg.num_envs
        self.spec = spec = ROBOTS[cfg.robot]()
        modulated = cfg.upper_body.modulation.targets([arm.side for arm in spec.arms])
        self.num_lower, self._num_joints = len(spec.lower_joints), len(spec.joints)
        self.num_actions = self._num_joints + len(modulated)
        self.action_slices = {"lower": slice(0, self.num_lower), "upper": slice(self.num_lower, self.num_actions)}
        needed = BYTES_PER_JOINT * len(spec.joints) * cfg.num_envs
        require_memory(f"num_envs {quoted(cfg.num_envs)}", needed, simulated_on(cfg.backend))
        model = build_model(spec, cfg.collision, cfg.control_dt / cfg.substeps, cfg.fixed_base, cfg.unevenness_m)
        model.actuator_forcerange[:] *= cfg.torque_limit_scale
        self.sim = make_simulation(cfg.backend, model, self.num_envs, cfg.substeps, cfg.num_threads, Randomizer.FIELDS)
        self.device, self.dt = self.sim.device, self.sim.dt
        self.max_episode_length = math.ceil(cfg.terminations.episode_s / self.dt - 1e-6)  # a quotient is rounded
        self.rng = torch.Generator(self.device).manual_seed(cfg.seed)
        with torch.device(self.device):  # where every part makes its tensors
            self._assemble()
        self.reset()

    def _assemble(self) -> None:
        """Make all parts and their tensors."""
        cfg, spec, n, dt, model = self.cfg, self.spec, self.num_envs, self.dt, self.sim.model
        limit = cfg.torque_limit_scale * torch.tensor([j.torque_limit_nm for j in spec.joints])
        self.reader = StateReader(spec, self.sim)
        self.arm_limits = self.reader.arm_joints(limit.unsqueeze(0))[0]
        self.joint_targets = JointTargets(cfg.actions, spec, cfg.upper_body.modulation.kind != "none")
        self.commands = CommandSource(cfg.commands, cfg.gait, n, spec.nominal_height_m, dt)
        self.motions = ReferenceMotion(cfg.motions, spec, n, dt)
        self.path = PathFollower(cfg.path, n, dt)
        self.forces = ExternalForces(cfg.forces, spec, model, self.reader, self.arm_limits, n, dt)
        self.randomizer = Randomizer(cfg.randomization, spec, self.sim)
        self.upper_body = UpperBody(cfg.upper_body, spec, n, dt)
        own, laws = self.joint_targets.bound, self.upper_body.modulation.action_bounds
        self._action_bounds = [torch.cat((side * own, law)) for side, law in zip((-1.0, 1.0), laws, strict=True)]
        self.actuation = Actuation(spec, self.sim, self.randomizer, self.upper_body, limit)
        self.observer = Observer(cfg.observations, spec, n, cfg.upper_body.modulation)
        self.recorder = Recorder(spec, self.reader, n, dt, cfg.gait.period_s)
        self._groups = tuple(RewardGroup(g, getattr(cfg.rewards, g), dt) for g in self.reward_groups)
        self._assist = AssistWrench(cfg.assist, spec, torch.as_tensor(torso_inertia(spec, model)), dt)
        self._torso = model.body(spec.torso_body).id
        self.curriculum = Curriculum(cfg.curriculum, dt)
        self.motions.share = self.curriculum.arm_motion
        self._min_height_m = cfg.terminations.min_height_m(spec)
        self.samples = self.num_diverged = 0
        self.keeps_final_observation = False
        """Whether `final_observation` (N, O) and `diverged` (N,) are kept of envs that end, as Gymnasium asks for."""
        self.redraws = True
        """Whether an env that ends draws body, commands, motion and forces anew, as it does in training. Where it does
        not, it goes on with those that it had, so that no other env's random numbers depend on who falls."""
        self.diverged = torch.zeros(n, dtype=torch.bool)
        self.episode_length_buf = torch.zeros(n, dtype=torch.long)
        self.torque = torch.zeros(n, self._num_joints)
        """(N, J) joint torques at the end of the last step [Nm]; zero in envs that have just restarted."""
        self.randomizer.randomize_bodies(self.rng)
        self.state: RobotState
        self.record: StepRecord

    @property
    def obs_groups(self) -> dict[str, list[str]]:
        """Which observation groups actors and critics read (rsl_rl's `obs_groups`)."""
        return self.observer.groups

    @property
    def hand_force_w(self) -> torch.Tensor:
        """(N, H, 3) force at each hand in the last step, world frame [N]."""
        return self.forces.hand_force_w

    @property
    def symmetry(self) -> Symmetry:
        """The mirror images of observations and actions."""
        return self.observer.symmetry(self.spec)

    def layout(self) -> dict[str, Any]:
        """What a policy must agree with: robot, joints, observation terms, action convention. Plain data."""
        own = {"robot": self.spec.name, "joints": self.spec.joint_names, "control_dt": self.cfg.control_dt}
        laws = self.cfg.upper_body.modulation.layout([arm.side for arm in self.spec.arms])
        return json.loads(json.dumps(own | self.observer.layout() | {"actions": vars(self.cfg.actions)} | laws))

    def reset(self, start: tuple[torch.Tensor, torch.Tensor] | None = None) -> TensorDict:
        """Restart every env, from `qpos` (N, 7 + J) and `qvel` (N, 6 + J) if given; return the observations."""
        everyone = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        self._restart(everyone, start)
        return self._observe(everyone)

    def reset_identical(self, seed: int) -> TensorDict:
        """Restart every env with the same random numbers, so that all start in one state; return the observations."""
        require_seed("seed", seed)
        ids = torch.arange(self.num_envs, device=self.device)
        for i in range(self.num_envs):
            self.rng.manual_seed(seed)
            self._restart(ids == i)
        return self._observe(ids >= 0)

    def get_observations(self) -> TensorDict:
        """The present observations, by group: `policy` with history, what critics see, and what is `privileged`."""
        return self._observations

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advance by one control step.

        Args:
            actions: (N, J), joint by joint; with learned modulation (N, J + M), what is asked of the laws behind.

        Returns:
            Observations, rewards (N,), dones (N,), extras with `time_outs` (N,), `falls` (N,), `group_rewards`
            (N, groups), `log`.

        Raises:
            ValueError: actions have another shape or are not finite.
        """
        require_shape("actions", actions, (self.num_envs, self.num_actions))
        require_all_finite("actions", actions)
        action = actions.clamp(*self._action_bounds)
        velocity_before = self.state.joint_vel
        self._act(action)
        self.sim.step(self.actuation.drive)

        bad = diverged(self.sim.qpos, self.sim.qvel)
        self.state = self.reader.read()
        self.torque = self.actuation.joint_torque(self.state)
        self.samples += self._total_envs
        self.episode_length_buf += 1
        self._advance()
        tilt = self.cfg.terminations.max_tilt_rad
        fell = fallen(self.state.height, self.state.projected_gravity_t, self._min_height_m, tilt) | bad
        time_out = (self.episode_length_buf >= self.max_episode_length) & ~fell
        self.record = self.recorder.record(
            self.state, self.commands.current(), self.motions.current(), action, self.observer.last_action,
            (self.state.joint_vel - velocity_before) / self.dt, self.torque, self.actuation.current, fell,
            self.hand_force_w, self.forces.hand_push_w, self.upper_body.compliant,
        )  # fmt: skip
        self.curriculum.step(fell, self._total_envs)
        self.num_diverged += int(bad.sum())
        rewards, log = self._reward(bad, time_out)
        self.observer.last_action = action
        done = fell | time_out
        if done.any():
            if self.keeps_final_observation:
                self._keep_final_observation(bad)
            self._restart(done)
        extras = {"time_outs": time_out, "falls": fell, "group_rewards": rewards, "log": log}
        return self._observe(done), rewards.sum(1), done, extras

    def _act(self, action: torch.Tensor) -> None:
        """Send targets and set forces. The reference moves first: arms are sent where it will be at the step's end."""
        self.motions.share = self.curriculum.arm_motion
        self.motions.step(self.rng)
        reference = self.motions.current()
        joints, laws = action.tensor_split((self._num_joints,), 1)
        self.upper_body.modulate(laws)
        self.actuation.send(self.state, self.joint_targets(joints, reference.position), reference.velocity)
        xfrc = self.sim.xfrc
        self.forces.apply(xfrc, self.state, self.dt * self.episode_length_buf.double(), self.curriculum.samples)
        if share := self.cfg.assist.share(self.samples):
            xfrc[:, self._torso] += share * self._assist(self.state, self.commands.current()).to(xfrc)

    def _advance(self) -> None:
        """Let commands, laws and forces go on by one control step."""
        s = self.state
        self.commands.step(self.rng)
        if self.cfg.path.share > 0.0:
            velocity, yaw_rate = self.path.step(s.torso_pos_w[:, :2], s.heading_w, self.motions.root_velocity())
            self.commands.set_velocity(velocity, yaw_rate, self.path.active)
        if self.upper_body.active:
            self.upper_body.sense(s, self.hand_force_w, self.actuation.arm_effort)
        self.upper_body.step(self.rng)
        self.forces.step(self.curriculum.samples, self.rng)

    def _reward(self, bad: torch.Tensor, time_out: torch.Tensor) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Each group's reward (N, groups), and the log. A diverged env (`bad`) has neither; it ends and is counted."""
        ok = ~bad if bad.any() else slice(None)  # picking all of the envs by a mask would copy them
        log = step_log(self.record, time_out, ok, self.dt)
        totals: list[torch.Tensor] = []
        for group in self._groups:
            total, terms = group(self.record)
            totals.append(total)
            means = terms[:, ok].mean(1).nan_to_num(0.0)  # none are left where all have diverged
            log.update({f"/{group.name}/{name}": mean for name, mean in zip(group.terms, means.unbind(), strict=True)})
        if self.upper_body.active:
            at_limit = self.torque.abs() > 0.999 * self.actuation.torque_limit
            log |= self.upper_body.log | {"/law/saturated": at_limit[:, self.num_lower :].float().mean()}
        log["/episode/diverged"] = torch.tensor(float(self.num_diverged))
        log["/curriculum/assist"] = torch.tensor(self.cfg.assist.share(self.samples))
        log["/curriculum/arm_motion"] = torch.tensor(self.curriculum.arm_motion)
        log["/curriculum/samples"] = torch.tensor(float(self.curriculum.samples))
        return torch.stack(totals, 1).masked_fill(bad.unsqueeze(1), 0.0), log

    def _restart(self, mask: torch.Tensor, start: tuple[torch.Tensor, torch.Tensor] | None = None) -> None:
        """Begin new episodes in the n envs of `mask` (N,), from `qpos` (n, 7 + J) and `qvel` (n, 6 + J) if given."""
        before = None if self.redraws else self.rng.get_state()
        if self.redraws:
            self.randomizer.randomize_episode(mask, self.actuation.delay_s, self.rng)
            for part in (self.commands, self.motions, self.forces):
                part.reset(mask, self.rng)
        self.upper_body.reset(mask, self.rng)
        qpos, qvel = start or start_state(self.cfg, self.spec, self.motions.current().position[mask], self.rng)
        self.sim.reset(mask, qpos, qvel)
        self.actuation.reset(mask, qpos[:, 7:])
        for held in (self.observer, self.recorder):
            held.reset(mask)
        self.torque = self.torque.masked_fill(mask.unsqueeze(1), 0.0)
        self.episode_length_buf = self.episode_length_buf.masked_fill(mask, 0)
        if mask.all():
            self.state = self.reader.read()
        else:
            ids = mask.nonzero().squeeze(1)
            self.state = self.state.with_envs(ids, self.reader.read(ids))
        self.path.reset(mask, self.state.torso_pos_w[:, :2], self.state.heading_w, self.rng)
        if before is not None:
            self.rng.set_state(before)
        if self.cfg.path.share > 0.0:  # those that are led walk from their first observation on
            still = torch.zeros_like(self.state.torso_pos_w)
            self.commands.set_velocity(still[:, :2], still[:, 2], self.path.active & mask)

    def _observe(self, restarted: torch.Tensor) -> TensorDict:
        """Observe the present; envs in `restarted` (N,) have no history before it."""
        ahead = self.forces.ahead(self.state.heading_w, self.curriculum.samples)
        errors = self.recorder.mean_error
        groups = self.observer.observe(
            **self._observed(), mean_error=errors, ahead=ahead, restarted=restarted, rng=self.rng
        )
        self._observations = TensorDict(cast(Any, groups), batch_size=[self.num_envs])
        return self._observations

    def _observed(self) -> dict[str, Any]:
        """What observations are made of."""
        return {
            "s": self.state,
            "command": self.commands.current(),
            "arm_reference": self.motions.current().position,
            "torque": self.torque,
            "hand_force_w": self.hand_force_w,
            "goals": self.upper_body.parameters,
        }

    def _keep_final_observation(self, bad: torch.Tensor) -> None:
        """A diverged env (`bad`) has no observation to show; the one before stands for it."""
        last, self.diverged = self._observations["policy"], bad
        seen = self.observer.preview(**self._observed())
        self.final_observation = torch.where(bad.unsqueeze(1), cast(torch.Tensor, last), seen)

    def set_law(self, env: int, arm: int, law: LawConfig) -> None:
        """Put one arm of one env under another law, from the next step on. Raises ValueError as `law.check` does."""
        self.actuation.set_law(env, arm, law)

    def arm_stiffness(self) -> torch.Tensor:
        """Joint stiffness of the arms under the laws in force, (N, A, n, n) [Nm/rad]."""
        return self.actuation.arm_stiffness()

    def state_dict(self) -> dict[str, Any]:
        """All that the environment's future depends on, on the CPU whatever the device."""
        return env_state(self)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on exactly where `state_dict` was taken; on another kind of device or with another backend, with its own
        arithmetic and random numbers. Raises ValueError for another number of envs."""
        self._observations = restore_env(self, state)
        self.state = self.reader.read()
