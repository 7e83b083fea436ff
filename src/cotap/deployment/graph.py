"""From a checkpoint to one ONNX file: both actors, observation normalisation, and all that is fed forward."""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from cotap import __version__
from cotap.agents.actors import DualActorCritic
from cotap.agents.checkpoint import require_layout, sha256
from cotap.configs import to_plain
from cotap.deployment.metadata import ACTION, FORMAT, INPUT, TARGETS, PolicyMetadata
from cotap.deployment.policy import OnnxPolicy
from cotap.envs import H1EnvConfig
from cotap.envs.actions import JointTargets
from cotap.envs.commands import Command
from cotap.envs.observations import ObservationHistory, actor_terms
from cotap.evaluation.policy import load_policy
from cotap.files import write_atomically
from cotap.robots import ROBOTS, RobotSpec
from cotap.robots.mjcf import build_model

OPSET = 20
ORDER = "term by term; within a term oldest step first; a step in the order of the joints; each value times its scale"
FRAMES = (
    "angular velocity and the unit vector of gravity in the torso link's frame; commanded velocity in the heading "
    "frame (z up, x along the torso's yaw); joint positions relative to the default pose; arm torque is what the law "
    "in force gives at the present state, within the torque limits"
)


class ActorGraph(nn.Module):
    """What is exported: raw observation (N, W) to joint targets (N, J) [rad] and action (N, J).

    Steps and stance are fed forward from what the observation's newest step holds; the gait's phase is the angle of
    its sine and cosine. The arms' reference is the one observed.
    """

    def __init__(self, model: DualActorCritic, targets: JointTargets, history: ObservationHistory) -> None:
        super().__init__()
        self.model = model
        self._targets = targets
        self._newest: dict[str, tuple[slice, float]] = {}
        start = 0
        for name, width, scale in history.terms:
            end = start + width * history.steps
            self._newest[name] = (slice(end - width, end), scale)
            start = end

    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Joint targets and action."""
        clip = self._targets.cfg.clip
        action = self.model({"policy": observation}).clamp(-clip, clip)
        seen = {name: observation[:, columns] / scale for name, (columns, scale) in self._newest.items()}
        phase = torch.atan2(seen["sin_phase"], seen["cos_phase"]) / (2.0 * math.pi)
        command = Command(
            seen["command_velocity"], seen["command_yaw_rate"][:, 0], seen["command_stand"][:, 0],
            seen["command_height"][:, 0], phase[:, 0].remainder(1.0),
        )  # fmt: skip
        targets = self._targets(
            action, command, seen["joint_position"] + self._targets.default, seen["joint_velocity"],
            seen["projected_gravity"], seen["torso_angular_velocity"], seen["reference_arm_position"],
        )  # fmt: skip
        return targets, action


def export_policy(checkpoint: Path | str, output: Path, checks: int = 1000, seed: int = 0) -> tuple[str, float]:
    """Write `output`, whole or not at all, once its numbers are found to be torch's.

    Returns the metadata's summary and the largest difference from torch over `checks` observations.

    Raises:
        CheckpointError: the checkpoint cannot be used, or its observation is not the one that cotap builds.
        ArithmeticError: the file's numbers are not torch's.
        OSError: it cannot be written.
    """
    policy = load_policy(checkpoint)
    cfg = policy.env_config
    spec = ROBOTS[cfg.robot]()
    history = ObservationHistory(actor_terms(len(spec.joints), len(spec.upper_joints)), 1, cfg.observations.history)
    layout = {"joints": list(spec.joint_names), "terms": [list(t) for t in history.terms], "history": history.steps}
    require_layout(checkpoint, policy.layout, layout)
    targets = JointTargets(cfg.actions, spec, build_model(spec), cfg.commands)
    graph = ActorGraph(policy.model, targets, history).eval()
    metadata = describe(cfg, spec, targets, history, policy.model, policy.stage, sha256(checkpoint))
    worst = 0.0

    def write(temporary: Path) -> None:
        nonlocal worst
        _write_onnx(temporary, graph, metadata)
        worst = largest_difference(OnnxPolicy(temporary), graph, typical_observations(graph, history, checks, seed))
        if not worst <= 1e-5:
            raise ArithmeticError(f"the ONNX file's targets differ from torch's by up to {worst:.2e} rad")

    write_atomically(output, write)
    return f"{metadata.robot}, {metadata.stage}, opset {metadata.opset}", worst


def describe(
    cfg: H1EnvConfig, spec: RobotSpec, targets: JointTargets, history: ObservationHistory, model: DualActorCritic,
    stage: str, checkpoint_sha256: str,
) -> PolicyMetadata:  # fmt: skip
    """The metadata of a policy that was trained in the environment `cfg`."""
    laws, joints = cfg.upper_body, spec.joints
    sampling = to_plain(laws.sampling)
    ranges = {name: sampling[name] for name in ("stiffness", "null_stiffness", "alpha")}
    return PolicyMetadata(
        format=FORMAT,
        robot=spec.name,
        stage=stage,
        joints=list(spec.joint_names),
        default_pose_rad=[j.default_rad for j in joints],
        action_scale_rad=[round(v, 9) for v in targets.scale.tolist()],
        action_clip=cfg.actions.clip,
        arm_action={"mode": cfg.actions.upper_mode, "reference_lead_s": cfg.actions.reference_lead_s},
        agents={name: [s.start, s.stop] for name, s in model.layout.action_slices.items()},
        kp=[j.kp for j in joints],
        kd=[j.kd for j in joints],
        torque_limit_nm=[cfg.torque_limit_scale * j.torque_limit_nm for j in joints],
        joint_range_rad=[list(j.range_rad) for j in joints],
        velocity_limit_rad_s=[j.velocity_limit_rad_s for j in joints],
        nominal_height_m=spec.nominal_height_m,
        control_dt=cfg.control_dt,
        observation={"terms": [list(t) for t in history.terms], "history": history.steps, "order": ORDER,
                     "frames": FRAMES},
        commands=asdict(cfg.commands),
        law={"left": to_plain(laws.left), "right": to_plain(laws.right), "torso": to_plain(laws.torso),
             "singularity_ratio": laws.singularity_ratio, "ranges": ranges if laws.sampling.enabled else None},
        checkpoint_sha256=checkpoint_sha256,
        cotap_version=__version__,
        opset=OPSET,
    )  # fmt: skip


def typical_observations(graph: ActorGraph, history: ObservationHistory, count: int, seed: int) -> torch.Tensor:
    """Observations (count, W) spread as the normaliser knows them, with stand flags and gait phases that can occur."""
    rng = torch.Generator().manual_seed(seed)
    normalizer: Any = graph.model.normalizers["policy"]
    spread = torch.randn(count, history.width * history.steps, generator=rng)
    observations = normalizer.mean + normalizer.std * spread
    stand = (torch.rand(count, generator=rng) < 0.5).float()
    angle = 2.0 * math.pi * torch.rand(count, generator=rng)
    values = {
        "command_stand": stand,
        "sin_phase": (1.0 - stand) * angle.sin(),
        "cos_phase": (1.0 - stand) * angle.cos(),
    }
    start = 0
    for name, width, _ in history.terms:
        end = start + width * history.steps
        if name in values:
            observations[:, start:end] = values[name].unsqueeze(1)
        start = end
    return observations


@torch.no_grad()
def largest_difference(policy: OnnxPolicy, graph: ActorGraph, observations: torch.Tensor) -> float:
    """Largest difference of targets [rad] and actions over `observations` (N, W)."""
    expected = np.concatenate([value.numpy() for value in graph(observations)], 1)
    got = np.stack([np.concatenate(policy(row)) for row in observations.numpy()])
    return float(np.abs(got - expected).max())


@contextmanager
def _quiet(logger: logging.Logger) -> Iterator[None]:
    """No word of operators that nothing here uses."""
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


def _write_onnx(path: Path, graph: ActorGraph, metadata: PolicyMetadata) -> None:
    import onnx

    example = torch.zeros(1, metadata.observation_width)
    with warnings.catch_warnings(), _quiet(logging.getLogger("torch.onnx")):
        warnings.simplefilter("ignore")  # torch warns of its own coming changes
        program = torch.onnx.export(
            graph, (example,), input_names=[INPUT], output_names=[TARGETS, ACTION], opset_version=OPSET, dynamo=True,
            verbose=False,
        )  # fmt: skip
    assert program is not None
    proto = program.model_proto
    proto.producer_name = "cotap"
    onnx.helper.set_model_props(proto, metadata.to_properties())
    onnx.checker.check_model(proto)
    onnx.save(proto, path)
