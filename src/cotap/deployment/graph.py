"""From a checkpoint to one ONNX file: observation in, joint targets out, and perhaps what the arms' laws are asked."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from cotap import __version__
from cotap.agents.actors import DualActorCritic
from cotap.agents.checkpoint import require_layout, sha256
from cotap.configs import to_plain
from cotap.deployment.golden import golden_steps
from cotap.deployment.metadata import FORMAT, INPUT, LAW_TARGETS, TARGETS, PolicyMetadata
from cotap.deployment.policy import OnnxPolicy
from cotap.deployment.terms import about_terms
from cotap.envs import HumanoidEnvConfig
from cotap.envs.actions import JointTargets
from cotap.envs.modulation import Modulation
from cotap.envs.observations import Term, actor_terms
from cotap.envs.terminations import TerminationConfig
from cotap.evaluation.policy import load_policy
from cotap.files import write_atomically
from cotap.robots import ROBOTS, RobotSpec

OPSET = 20
ORDER = "term by term; within a term oldest step first; a step in the order of the joints; each value times its scale"
FRAMES = (
    "angular velocity and the unit vector of gravity in the torso link's frame; commanded velocity in the heading "
    "frame (z up, x along the torso's yaw); joint positions relative to the default pose; arm torque is what the law "
    "in force gives at the present state, within the torque limits"
)


class TargetGraph(nn.Module):
    """What is exported: raw observations (N, W) to joint targets (N, J) [rad], and with learned modulation to what is
    asked of the laws (N, M). The arms' reference is the newest one observed."""

    def __init__(self, model: DualActorCritic, targets: JointTargets, modulation: Modulation, reference: slice) -> None:
        super().__init__()
        self.model = model
        self._targets, self._modulation, self._reference = targets, modulation, reference

    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """All outputs."""
        action, bound = self.model({"policy": observation}), self._targets.bound
        joints = len(bound)
        targets = self._targets(action[:, :joints].clamp(-bound, bound), observation[:, self._reference])
        if not self._modulation.size:
            return (targets,)
        return targets, self._modulation.wanted(action[:, joints:])


def newest(terms: tuple[Term, ...], history: int, wanted: str) -> slice:
    """Columns of an observation that hold the newest step of the term called `wanted`."""
    end = 0
    for name, width, _ in terms:
        end += width * history
        if name == wanted:
            return slice(end - width, end)
    raise ValueError(f"the observation has no term {wanted!r}")


def export_policy(checkpoint: Path | str, output: Path, checks: int = 1000, seed: int = 0) -> tuple[str, float]:
    """Write `output`, whole or not at all, once its numbers are found to be torch's.

    Returns the metadata's summary and the largest difference from torch over `checks` observations [rad].

    Raises:
        CheckpointError: the checkpoint cannot be used, or its observation is not one that a robot can make.
        ArithmeticError: the file's numbers are not torch's.
        OSError: it cannot be written.
    """
    policy = load_policy(checkpoint)
    cfg = policy.env_config
    spec = ROBOTS[cfg.robot]()
    terms, history = terms_of(cfg, spec), cfg.observations.history
    sides = [arm.side for arm in spec.arms]
    layout = {"joints": list(spec.joint_names), "terms": [list(t) for t in terms], "history": history}
    layout |= cfg.upper_body.modulation.layout(sides)
    require_layout(checkpoint, policy.layout, layout)
    targets = JointTargets(cfg.actions, spec, cfg.upper_body.modulation.kind != "none")
    reference = newest(terms, history, "reference_arm_position")
    modulation = Modulation(cfg.upper_body.modulation, [cfg.upper_body.of(side) for side in sides], cfg.control_dt)
    graph = TargetGraph(policy.model, targets, modulation, reference).eval()
    with torch.no_grad():
        steps, observation = golden_steps(
            cfg, spec, terms, history, lambda seen: graph(seen)[0],
            lambda arms: targets(torch.zeros(1, len(spec.joints), dtype=arms.dtype), arms), targets.scale.double(),
            seed,
        )  # fmt: skip
        found = zip((TARGETS, LAW_TARGETS), graph(observation.unsqueeze(0)), strict=False)
        golden = steps | {"observation": observation.tolist()} | {name: values[0].tolist() for name, values in found}
    metadata = describe(cfg, spec, targets, policy.stage, sha256(checkpoint), golden)
    worst = 0.0

    def write(temporary: Path) -> None:
        nonlocal worst
        _write_onnx(temporary, graph, metadata)
        worst = largest_difference(OnnxPolicy(temporary), graph, checks, seed)
        if not worst <= 1e-5:
            raise ArithmeticError(f"the ONNX file's targets differ from torch's by up to {worst:.2e} rad")

    write_atomically(output, write)
    return f"{metadata.robot}, {metadata.stage}, opset {metadata.opset}", worst


def terms_of(cfg: HumanoidEnvConfig, spec: RobotSpec) -> tuple[Term, ...]:
    """Terms of the observation that a robot makes for a policy trained in `cfg`."""
    laws = cfg.upper_body.modulation.terms(len(spec.arms))
    return actor_terms(len(spec.joints), len(spec.upper_joints), cfg.observations.arm_torque == "actor", laws=laws)


def describe(
    cfg: HumanoidEnvConfig, spec: RobotSpec, targets: JointTargets, stage: str, checkpoint_sha256: str,
    golden: dict[str, Any],
) -> PolicyMetadata:  # fmt: skip
    """The metadata of a policy that was trained in the environment `cfg`."""
    joints, terms = spec.joints, terms_of(cfg, spec)
    modulated = cfg.upper_body.modulation.targets([arm.side for arm in spec.arms])
    return PolicyMetadata(
        format=FORMAT,
        robot=spec.name,
        stage=stage,
        joints=list(spec.joint_names),
        default_pose_rad=[j.default_rad for j in joints],
        kp=[j.kp for j in joints],
        kd=[j.kd for j in joints],
        torque_limit_nm=[cfg.torque_limit_scale * j.torque_limit_nm for j in joints],
        action={"scale_rad": [round(v, 9) for v in targets.scale.tolist()], "clip": cfg.actions.clip,
                "upper_mode": targets.upper_mode, **({"law_targets": modulated} if modulated else {})},
        observation={"terms": [list(t) for t in terms], "history": cfg.observations.history,
                     "about": about_terms(cfg, spec, terms), "order": ORDER, "frames": FRAMES},
        control_dt=cfg.control_dt,
        gait=to_plain(cfg.gait),
        commands=to_plain(cfg.commands),
        nominal_height_m=spec.nominal_height_m,
        terminations=to_plain(TerminationConfig()),  # training may go on further
        law=to_plain(cfg.upper_body),
        golden=golden,
        checkpoint_sha256=checkpoint_sha256,
        cotap_version=__version__,
        opset=OPSET,
    )  # fmt: skip


def typical_observations(graph: TargetGraph, count: int, seed: int) -> Iterator[torch.Tensor]:
    """Observations (count, W) spread as the normaliser knows them, a thousand at a time."""
    rng = torch.Generator().manual_seed(seed)
    normalizer: Any = graph.model.normalizers["policy"]
    for begin in range(0, count, 1000):
        drawn = torch.randn(min(1000, count - begin), normalizer.mean.shape[-1], generator=rng)
        yield normalizer.mean + normalizer.std * drawn


@torch.no_grad()
def largest_difference(policy: OnnxPolicy, graph: TargetGraph, count: int, seed: int) -> float:
    """Largest difference of targets [rad, and laws' units] over so many typical observations; NaN if one is."""
    worst = [
        np.abs(np.stack([policy(row) for row in part.numpy()]) - torch.cat(graph(part), 1).numpy()).max()
        for part in typical_observations(graph, count, seed)
    ]
    return float(np.max(worst))


@contextmanager
def _quiet(logger: logging.Logger) -> Iterator[None]:
    """No word of operators that nothing here uses."""
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


def _write_onnx(path: Path, graph: TargetGraph, metadata: PolicyMetadata) -> None:
    import onnx

    example = torch.zeros(1, metadata.observation_width)
    outputs = [TARGETS, LAW_TARGETS] if metadata.law_targets else [TARGETS]
    with warnings.catch_warnings(), _quiet(logging.getLogger("torch.onnx")):
        warnings.simplefilter("ignore")  # torch warns of its own coming changes
        program = torch.onnx.export(
            graph, (example,), input_names=[INPUT], output_names=outputs, opset_version=OPSET, dynamo=True,
            verbose=False,
        )  # fmt: skip
    assert program is not None
    proto = program.model_proto
    proto.producer_name = "cotap"
    onnx.helper.set_model_props(proto, metadata.to_properties())
    onnx.checker.check_model(proto)
    onnx.save(proto, path)
