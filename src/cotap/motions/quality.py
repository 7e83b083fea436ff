"""How well a clip does what its source did, and what it asks of the robot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from cotap.motions.elbow import elbow_index
from cotap.motions.library import FPS, MotionClip
from cotap.motions.processing import ClipReport, JointMotion, resample
from cotap.motions.retarget import arm_direction
from cotap.robots import RobotSpec
from cotap.robots.chains import arm_chains

SINGULAR = 10.0
"""Condition number of a hand's Jacobian beyond which an arm counts as near a singularity."""
_STILL_RAD = 1e-3
"""Standard deviation of an elbow that does not move: what is left is noise."""


@dataclass(frozen=True)
class ClipQuality:
    """One row of the importer's table. What a source does not allow to be measured is NaN."""

    seconds: float
    clipped_fraction: float
    slowed_fraction: float
    peak_speed_rad_s: float
    hand_path_error_m: float
    """Mean distance of the hands from where the source, scaled to the robot's arms, has them, shoulders together."""
    hand_direction_error_deg: float
    """Mean angle between the directions from shoulder to hand; NaN where the source stores joints."""
    elbow_correlation: float
    """Smallest correlation over both arms of elbow flexion with the source's; NaN where the source stores joints, and
    where no elbow moves."""
    singular_fraction: float
    root_speed_m_s: float
    """Peak of the root's horizontal speed."""
    root_turn_rad_s: float
    """Peak of its turn rate."""


def peak_speed(clip: MotionClip) -> float:
    """Speed of the arms' fastest joint [rad/s]."""
    return float(np.abs(np.diff(clip.arms, axis=0)).max()) * FPS


def root_peaks(clip: MotionClip) -> tuple[float, float]:
    """Peaks of the root's horizontal speed [m/s] and turn rate [rad/s]."""
    rate = np.diff(clip.root.astype(float), axis=0) * FPS
    return float(np.linalg.norm(rate[:, :2], axis=1).max()), float(np.abs(rate[:, 2]).max())


def forward_kinematics(spec: RobotSpec, arms: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Shoulders, elbows and hands (T, A, 3) in the torso frame, and hand Jacobians (T, A, 3, n), for joints (T, U).

    The shoulder is where the upper arm's axis begins.
    """
    chains = arm_chains(spec)
    q = torch.as_tensor(arms, dtype=torch.float32).unflatten(1, (len(spec.arms), -1))
    pose = chains.pose(q)
    elbow = pose.anchors[:, range(len(spec.arms)), [elbow_index(spec, arm) for arm in spec.arms]]
    points = (pose.anchors[:, :, 1], elbow, pose.tip, chains.jacobian(pose))
    shoulder, elbow, hand, jacobian = (p.double().numpy() for p in points)
    return shoulder, elbow, hand, jacobian


def assess(spec: RobotSpec, motion: JointMotion, clip: MotionClip, report: ClipReport) -> ClipQuality:
    """Compare a finished clip with what it was made from."""
    shoulder, elbow, hand, jacobian = forward_kinematics(spec, clip.arms)
    condition = np.linalg.cond(jacobian)
    if motion.human is None:
        wanted = forward_kinematics(spec, resample(motion.times_s, motion.arms))[2]
        path, direction, correlation = float(np.linalg.norm(hand - wanted, axis=2).mean()), np.nan, np.nan
    else:
        path, direction, correlation = _against_human(spec, motion, shoulder, elbow, hand, jacobian)
    return ClipQuality(
        clip.seconds, report.clipped_fraction, report.slowed_fraction, peak_speed(clip), path, direction, correlation,
        float((condition > SINGULAR).any(1).mean()), *root_peaks(clip),
    )  # fmt: skip


def _against_human(
    spec: RobotSpec, motion: JointMotion, shoulder: np.ndarray, elbow: np.ndarray, hand: np.ndarray,
    jacobian: np.ndarray,
) -> tuple[float, float, float]:  # fmt: skip
    human = motion.human
    assert human is not None
    paths, angles, correlations = [], [], []
    for i, arm in enumerate(spec.arms):
        upper, fore = elbow[:, i] - shoulder[:, i], hand[:, i] - elbow[:, i]
        ratio = float(np.linalg.norm(fore, axis=1).mean() / np.linalg.norm(upper, axis=1).mean())
        # The reference directions at the source's own frames, then at the clip's.
        reference = arm_direction(human.upper_arms[arm.side], human.flexions[arm.side], ratio)
        flexion = resample(human.times_s, human.flexions[arm.side][:, None])[:, 0]
        reference = resample(human.times_s, reference)
        reference /= np.linalg.norm(reference, axis=1, keepdims=True)
        reach = hand[:, i] - shoulder[:, i]
        length = np.linalg.norm(reach, axis=1)
        cosine = (reach * reference).sum(1) / length
        angles.append(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).mean())
        upper_length = np.linalg.norm(upper, axis=1).mean()
        human_length = upper_length * np.sqrt(1.0 + ratio**2 + 2.0 * ratio * np.cos(flexion))
        paths.append(np.linalg.norm(reach - reference * human_length[:, None], axis=1).mean())
        # How the hand moves with the elbow's joint tells to which side of straight the forearm is.
        bend = np.arctan2((upper * jacobian[:, i, :, elbow_index(spec, arm)]).sum(1), (upper * fore).sum(1))
        if min(flexion.std(), bend.std()) > _STILL_RAD:
            correlations.append(np.corrcoef(bend, flexion)[0, 1])
    return float(np.mean(paths)), float(np.mean(angles)), float(min(correlations, default=np.nan))
