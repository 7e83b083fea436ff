from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from cotap.envs.actions import ActionConfig, JointTargets
from cotap.envs.commands import Command, CommandConfig
from cotap.envs.gait import StepMotion, desired_contact, sweep, swing_progress
from cotap.envs.symmetry import joint_reflection

PERIOD, STANCE = 0.8, 0.58


@pytest.mark.parametrize(
    ("phase", "left", "right"),
    [(0.0, True, True), (0.05, True, True), (0.1, True, False), (0.49, True, False), (0.55, True, True),
     (0.6, False, True), (0.95, False, True)],
)  # fmt: skip
def test_desired_contact_alternates(phase, left, right):
    assert desired_contact(torch.tensor([phase]), torch.zeros(1), 2).tolist() == [[left, right]]
    assert desired_contact(torch.tensor([phase]), torch.ones(1), 2).tolist() == [[True, True]]


def test_swing_progress_runs_from_lift_off_to_touch_down():
    phase = torch.tensor([0.3, 0.58, 0.79, 0.999])
    left = swing_progress(phase, 2)[:, 0]
    torch.testing.assert_close(left, torch.tensor([0.0, 0.0, 0.5, 0.9976]), atol=1e-3, rtol=0)
    torch.testing.assert_close(swing_progress(phase - 0.5, 2)[:, 1], left, atol=1e-5, rtol=0)


def test_sweep_moves_back_with_the_ground_and_forward_smoothly():
    phase = torch.linspace(0.0, 0.999, 1000)
    left = sweep(phase, 2)[:, 0]
    assert float(left[0]) == 1.0
    assert float(left.min()) == pytest.approx(-1.0, abs=0.01)
    assert float(left.diff().abs().max()) < 0.008  # no jump, the wrap-around below included
    assert float(left[-1]) == pytest.approx(1.0, abs=0.01)
    stance = left[: int(STANCE * 1000)]
    torch.testing.assert_close(stance.diff(), torch.full((579,), -2.0 / STANCE / 999 * 0.999), atol=1e-5, rtol=0)
    torch.testing.assert_close(sweep(phase - 0.5, 2)[:, 1], left, atol=1e-4, rtol=0)


def sole(spec, model, joints, foot):
    """Position and rotation of a foot's sole for joint angles, base at the origin."""
    data = mujoco.MjData(model)
    data.qpos[3], data.qpos[7:] = 1.0, joints
    mujoco.mj_kinematics(model, data)
    body = model.body(spec.feet[foot].body).id
    rotation = data.xmat[body].reshape(3, 3)
    return data.xpos[body] + rotation @ spec.feet[foot].sole, rotation


def offset_by(spec, motion: StepMotion, offsets: torch.Tensor, feet=(0, 1)) -> np.ndarray:
    """The default pose (J,) with the offsets (F, n) of these feet."""
    joints = np.array([j.default_rad for j in spec.joints])
    for foot in feet:
        joints[motion.joints[foot].numpy()] += offsets[foot].numpy()
    return joints


@pytest.mark.parametrize("foot", [0, 1])
@pytest.mark.parametrize(
    ("velocity", "yaw_rate"), [((0.2, 0.0), 0.0), ((0.0, 0.1), 0.0), ((0.0, 0.0), 0.2), ((-0.2, 0.05), -0.2)]
)
def test_soles_move_under_the_body_as_the_ground_would(spec, model, velocity, yaw_rate, foot):
    """Forward kinematics at touch-down against where the ground point of mid-stance was half a stance earlier."""
    motion = StepMotion(spec, model, PERIOD)
    touch_down = torch.tensor([0.5 * foot])
    offsets = motion(touch_down, torch.tensor([velocity]), torch.tensor([yaw_rate]))[0]
    joints = np.array([j.default_rad for j in spec.joints])
    middle, _ = sole(spec, model, joints, foot)
    joints[motion.joints[foot].numpy()] += offsets[foot].numpy()
    position, rotation = sole(spec, model, joints, foot)
    half_stance_s = 0.5 * STANCE * PERIOD
    expected = middle + half_stance_s * np.array([velocity[0] - yaw_rate * middle[1], velocity[1], 0.0])
    np.testing.assert_allclose(position, expected, atol=3e-3)
    assert np.arctan2(rotation[1, 0], rotation[0, 0]) == pytest.approx(half_stance_s * yaw_rate, abs=2e-3)
    assert rotation[0, 2] == pytest.approx(0.0, abs=5e-3)  # level fore and aft


def test_feet_are_put_apart_by_what_is_asked(spec, model):
    motion = StepMotion(spec, model, PERIOD, lift=0.0, stride=0.0, apart_m=0.06)
    offsets = motion(torch.tensor([0.3]), torch.zeros(1, 2), torch.zeros(1))[0]
    default, joints = np.array([j.default_rad for j in spec.joints]), offset_by(spec, motion, offsets)
    for foot, outward in ((0, 1.0), (1, -1.0)):
        (was, _), (now, rotation) = sole(spec, model, default, foot), sole(spec, model, joints, foot)
        assert now[1] - was[1] == pytest.approx(0.03 * outward, abs=1e-3)
        # By rolling the leg: its height is left to change as it will.
        np.testing.assert_allclose(now[[0, 2]], was[[0, 2]], atol=9e-3)
        assert rotation[2, 1] == pytest.approx(outward * 0.03 / 0.83, abs=4e-3)


def distance(spec, model, joints):
    """Between soles, sideways [m]."""
    return sole(spec, model, joints, 0)[0][1] - sole(spec, model, joints, 1)[0][1]


@pytest.mark.parametrize(("phase", "swinging"), [(0.79, 0), (0.29, 1)])
def test_the_swinging_foot_gives_way_by_what_is_missing(spec, model, phase, swinging):
    motion = StepMotion(spec, model, PERIOD, clear_m=0.15)
    roll = spec.indices(["left_hip_roll", "right_hip_roll"])
    joints = np.array([j.default_rad for j in spec.joints])
    rest, wide = torch.zeros(1, 19), torch.tensor(joints, dtype=torch.float32).unsqueeze(0)
    assert not motion.giving_way(torch.tensor([phase]), wide, rest).any()
    joints[roll] += -0.18, 0.18
    near = distance(spec, model, joints)
    assert 0.05 < near < 0.13
    position = torch.tensor(joints, dtype=torch.float32).unsqueeze(0)
    offsets = motion.giving_way(torch.tensor([phase]), position, rest)[0]
    assert not offsets[1 - swinging].any()
    joints[motion.joints[swinging].numpy()] += offsets[swinging].numpy()
    assert distance(spec, model, joints) == pytest.approx(0.15, abs=5e-3)
    # A foot that comes nearer is seen where it will be 0.1 s from now.
    coming = rest.clone()
    coming[:, roll] = torch.tensor([-1.0, 1.0])
    ahead = motion.giving_way(torch.tensor([phase]), position, coming)[0, swinging] - offsets[swinging]
    speed = (distance(spec, model, (position + 1e-3 * coming)[0].double().numpy()) - near) / 1e-3
    expected = offsets[swinging] * (-0.1 * speed / (0.15 - near))
    torch.testing.assert_close(ahead, expected.float(), rtol=0.02, atol=1e-5)


def test_giving_way_is_the_same_in_the_mirror(spec, model):
    motion = StepMotion(spec, model, PERIOD, clear_m=0.4)
    rng = torch.Generator().manual_seed(0)
    default = torch.tensor([j.default_rad for j in spec.joints])
    position, velocity = default + 0.2 * torch.randn(64, 19, generator=rng), torch.randn(64, 19, generator=rng)
    phase = torch.rand(64, generator=rng)
    mirror = joint_reflection(spec, spec.joint_names)

    def moved(phase, position, velocity):
        offsets = torch.zeros(64, 19)
        offsets[:, motion.joints] = motion.giving_way(phase, position, velocity)
        return offsets

    here = moved(phase, position, velocity)
    assert here.any(1).sum() > 8
    there = moved((phase + 0.5).remainder(1.0), mirror(position), mirror(velocity))
    torch.testing.assert_close(there, mirror(here), atol=1e-4, rtol=1e-3)


def test_feet_never_give_way_unless_asked_to(spec, model):
    motion = StepMotion(spec, model, PERIOD)
    crossed = torch.tensor([[j.default_rad for j in spec.joints]])
    crossed[:, spec.indices(["left_hip_roll", "right_hip_roll"])] = torch.tensor([-0.3, 0.3])
    assert not motion.giving_way(torch.tensor([0.79]), crossed, torch.zeros(1, 19)).any()


@pytest.mark.parametrize(("phase", "swinging"), [(0.79, 0), (0.29, 1)])
@pytest.mark.parametrize(("forward", "left"), [(0.2, 0.0), (0.0, 0.2), (-0.15, 0.1)])
def test_the_swinging_foot_does_not_reach_to_where_the_torso_leans(spec, model, phase, swinging, forward, left):
    """Forward kinematics: it comes down nearer by the share that was asked for, and the other one stays."""
    motion = StepMotion(spec, model, PERIOD, hold_back_m=0.3)
    # Gravity as a torso sees it that leans: forward by a pitch, to its left by a roll.
    gravity = torch.tensor([[forward, left, -((1.0 - forward**2 - left**2) ** 0.5)]])
    offsets = motion.holding_back(torch.tensor([phase]), gravity)[0]
    assert not offsets[1 - swinging].any()
    joints = np.array([j.default_rad for j in spec.joints])
    before, _ = sole(spec, model, joints, swinging)
    joints[motion.joints[swinging].numpy()] += offsets[swinging].numpy()
    after, _ = sole(spec, model, joints, swinging)
    np.testing.assert_allclose(after - before, [-0.3 * forward, -0.3 * left, 0.0], atol=6e-3)


def test_a_foot_is_held_back_within_bounds_and_only_if_asked_to(spec, model):
    swing, falling = torch.tensor([0.79]), torch.tensor([[0.9, 0.0, -0.436]])
    bound = StepMotion(spec, model, PERIOD, hold_back_m=0.3).holding_back(swing, torch.tensor([[0.5, 0.0, -0.866]]))
    assert torch.equal(StepMotion(spec, model, PERIOD, hold_back_m=0.3).holding_back(swing, falling), bound)
    assert not StepMotion(spec, model, PERIOD).holding_back(swing, falling).any()


@pytest.mark.parametrize(("tilt", "share"), [(0.0, 0.0), (0.05, 0.0), (0.125, 0.5), (0.2, 1.0), (0.9, 1.0)])
@pytest.mark.parametrize("towards", [(1.0, 0.0), (0.0, -1.0), (0.6, 0.8)])
def test_the_swinging_foot_is_lifted_higher_under_a_torso_that_leans(spec, model, tilt, share, towards):
    """Half as high again where it leans by 0.2 or more, nothing below 0.05, and the other foot stays."""
    phase, still, turn = torch.tensor([0.79]), torch.zeros(1, 2), torch.zeros(1)
    gravity = torch.tensor([[-tilt * towards[0], -tilt * towards[1], -((1.0 - tilt**2) ** 0.5)]])
    motion = StepMotion(spec, model, PERIOD, catch_lift=0.5)
    lift = motion(phase, still, turn)
    torch.testing.assert_close(motion.catching(phase, gravity), 0.5 * share * lift, atol=1e-5, rtol=0)
    assert lift[0, 0].any()
    assert not lift[0, 1].any()
    assert not StepMotion(spec, model, PERIOD).catching(phase, gravity).any()


def test_legs_damp_rolling_and_twisting_joints_and_no_other(spec, model):
    """Each rad/s sends a hip that rolls 0.02 rad and one that turns 0.01 rad the other way, on both legs alike."""
    motion = StepMotion(spec, model, PERIOD, roll_damping_s=0.02, twist_damping_s=0.01)
    velocity = 1.0 + torch.arange(len(spec.joints)).unsqueeze(0)
    offsets = motion.damping(velocity)[0]
    assert torch.equal(motion.damping(-velocity)[0], -offsets)
    for foot, side in enumerate(("left", "right")):
        sent = dict(zip([spec.joint_names[i] for i in motion.joints[foot]], offsets[foot].tolist(), strict=True))
        for name, damping_s in {"hip_roll": 0.02, "hip_yaw": 0.01, "hip_pitch": 0.0, "knee": 0.0, "ankle": 0.0}.items():
            moving = 1.0 + spec.joint_names.index(f"{side}_{name}")
            assert sent[f"{side}_{name}"] == pytest.approx(-damping_s * moving)
    assert not StepMotion(spec, model, PERIOD).damping(velocity).any()


def test_targets_are_damped_and_straightened_while_walking_only(spec, model):
    """Joint by joint, one world that walks and one that stands, both with legs at 2 rad/s."""
    given = {"step_roll_damping_s": 0.02, "step_twist_damping_s": 0.01, "step_straighten_rad": 0.03}
    stand = torch.tensor([0.0, 1.0])
    command = Command(torch.zeros(2, 2), torch.zeros(2), stand, torch.full((2,), 1.02), torch.full((2,), 0.3))
    gravity, zeros = torch.tensor([[0.0, 0.0, -1.0]]).expand(2, -1), torch.zeros(2, len(spec.joints))

    def targets(**commands: float) -> torch.Tensor:
        make = JointTargets(ActionConfig(), spec, model, CommandConfig(**commands))
        joints = make.default.expand(2, -1)
        return make(zeros, command, joints, zeros + 2.0, gravity, torch.zeros(2, 3), torch.zeros(2, 8))

    walking, standing = targets(**given) - targets()
    moved = {"hip_roll": -0.04, "hip_yaw": -0.02, "knee": -0.03}
    expected = [moved.get(name.removeprefix("left_").removeprefix("right_"), 0.0) for name in spec.joint_names]
    torch.testing.assert_close(walking, torch.tensor(expected), atol=1e-6, rtol=0)
    assert not standing.any()


def test_knees_that_are_straightened_put_soles_further_down(spec, model):
    motion = StepMotion(spec, model, PERIOD, lift=0.0, stride=0.0, straighten_rad=0.03)
    offsets = motion(torch.tensor([0.3]), torch.zeros(1, 2), torch.zeros(1))[0]
    default, joints = np.array([j.default_rad for j in spec.joints]), offset_by(spec, motion, offsets)
    bent_less = dict(zip(spec.joint_names, default - joints, strict=True))
    assert {name: angle for name, angle in bent_less.items() if angle} == pytest.approx(
        {"left_knee": 0.03, "right_knee": 0.03}
    )
    for foot in range(2):
        (was, _), (now, _) = sole(spec, model, default, foot), sole(spec, model, joints, foot)
        assert now[2] < was[2] - 1e-3


def test_factors_scale_lift_and_stride_apart(spec, model):
    phase, velocity, turn = torch.tensor([0.79]), torch.tensor([[0.5, 0.0]]), torch.zeros(1)
    none = StepMotion(spec, model, PERIOD, lift=0.0, stride=0.0)(phase, velocity, turn)
    assert not none.any()
    lift = StepMotion(spec, model, PERIOD, lift=0.5, stride=0.0)(phase, velocity, turn)[0]
    torch.testing.assert_close(lift[0, 2:], 0.5 * torch.tensor([-0.35, 0.7, -0.35]), atol=1e-5, rtol=0)
    assert not lift[1].any()
    stride = StepMotion(spec, model, PERIOD, lift=0.0, stride=1.0)(phase, velocity, turn)[0]
    both = StepMotion(spec, model, PERIOD, lift=0.5, stride=1.0)(phase, velocity, turn)[0]
    torch.testing.assert_close(both, lift + stride)
    assert stride[0, 2] == pytest.approx(0.0, abs=1e-3)  # the left leg passes under the hip
    early = StepMotion(spec, model, PERIOD, lift=0.0)(torch.tensor([0.0]), velocity, turn)[0]
    assert early[0, 2] < -0.1  # the left foot touches down in front: its hip is bent
