"""Every term on a hand-made step: a robot that does all right, and one thing wrong with it at a time."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from cotap.compliance.kinematics import ChainPose
from cotap.envs.commands import Command
from cotap.envs.rewards import (
    LowerRewards,
    RewardGroup,
    StepRecord,
    UpperRewards,
    reward_group,
    term,
)
from cotap.envs.scales import RobotScales
from cotap.envs.state import RobotState
from cotap.motions.generator import ArmReference

DT = 0.02
HEIGHT = 1.0
GROUPS = (LowerRewards, UpperRewards)
TERMS = {name: declared.function for group in GROUPS for name, declared in group.TERMS.items()}
SCALES = RobotScales(
    joint_low=torch.full((5,), -0.5), joint_high=torch.full((5,), 0.5),
    default_position=torch.tensor([0.1, -0.2, 0.3, 0.0, 0.0]), num_lower=3, hip_waist=(0,), foot_clearance_m=0.1,
    foot_distance_m=0.18, torso_ahead_m=0.0, falling_time_s=0.3,
)  # fmt: skip
LEFT_LIFTED = {"desired_contact": [[False, True]], "swing": [[0.5, 0.0]]}


def matrix_about_z(yaw: float) -> torch.Tensor:
    c, s = math.cos(yaw), math.sin(yaw)
    return torch.tensor([[[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]])


def perfect() -> StepRecord:
    """One env of a robot with 3 lower and 2 upper joints that does just what it should."""
    eye = torch.eye(3).unsqueeze(0)
    state = RobotState(
        joint_pos=torch.tensor([[0.1, -0.2, 0.3, 0.0, 0.0]]),
        joint_vel=torch.zeros(1, 5),
        base_rotation_w=eye,
        torso_pos_w=torch.tensor([[3.0, -2.0, HEIGHT]]),
        torso_rotation_w=eye,
        heading_w=eye,
        torso_linear_velocity_h=torch.tensor([[0.5, -0.2, 0.0]]),
        torso_angular_velocity_t=torch.tensor([[0.0, 0.0, 0.4]]),
        yaw_rate=torch.tensor([0.4]),
        projected_gravity_t=torch.tensor([[0.0, 0.0, -1.0]]),
        arms=ChainPose(torch.zeros(1, 2, 1, 3), torch.zeros(1, 2, 1, 3), eye.repeat(1, 2, 1, 1), torch.zeros(1, 2, 3)),
        foot_force=torch.tensor([[250.0, 250.0]]),
        foot_pos_w=torch.tensor([[[3.0, -1.9, 0.0], [3.0, -2.1, 0.0]]]),
        foot_velocity_w=torch.zeros(1, 2, 3),
        foot_up_w=torch.tensor([[[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]]]),
        foot_forward_w=torch.tensor([[[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]]),
    )
    zero = torch.zeros(1, 5)
    points = torch.tensor([[[0.2, 0.2, 0.1], [0.2, -0.2, 0.1]]])
    return StepRecord(
        state=state,
        command=Command(
            torch.tensor([[0.5, -0.2]]), torch.tensor([0.4]), torch.zeros(1), torch.tensor([HEIGHT]), torch.zeros(1)
        ),
        reference=ArmReference(torch.zeros(1, 2), torch.zeros(1, 2)),
        action=zero,
        last_action=zero.clone(),
        joint_acceleration=zero.clone(),
        torque=zero.clone(),
        arm_target=torch.zeros(1, 2),
        desired_contact=torch.tensor([[True, True]]),
        swing=torch.zeros(1, 2),
        key_points_t=points,
        key_points_reference_t=points.clone(),
        key_velocities_t=torch.zeros(1, 2, 3),
        key_velocities_reference_t=torch.zeros(1, 2, 3),
        mean_error=torch.zeros(1, 3),
        fell=torch.tensor([False]),
        hand_force_w=torch.zeros(1, 1, 3),
        hand_push_w=torch.zeros(1, 1, 3),
        compliant_arms=torch.tensor([[False]]),
        scales=SCALES,
    )


def changed(**changes) -> StepRecord:
    """The perfect step with some tensors, of the record, its state, command or reference, replaced."""
    record = perfect()
    for name, value in changes.items():
        holder = next(h for h in (record, record.state, record.command, record.reference) if hasattr(h, name))
        if not isinstance(value, RobotScales):
            value = torch.as_tensor(value)
            assert value.shape == getattr(holder, name).shape
        new = dataclasses.replace(holder, **{name: value})
        if holder is record:
            record = new
        else:
            field = next(f for f in ("state", "command", "reference") if getattr(record, f) is holder)
            record = dataclasses.replace(record, **{field: new})
    return record


def two_arms(forced: tuple[bool, bool], compliant: tuple[bool, bool]) -> StepRecord:
    """The perfect step of a robot with an arm to each upper joint: joints off by 0.1 and 0.3 rad, hands by 0.1 and
    0.2 m and 1 and 2 m/s, elbows by nothing and 0.1 m; forces on some hands, compliance on some arms."""
    off = torch.tensor([[[0.1, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.1]]])
    speed = torch.tensor([[[1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]])
    force = 5.0 * torch.tensor([forced]).unsqueeze(2).expand(1, 2, 3)
    still = dataclasses.replace(perfect().state, torso_angular_velocity_t=torch.zeros(1, 3))
    return dataclasses.replace(
        perfect(), state=dataclasses.replace(still, joint_pos=torch.tensor([[0.1, -0.2, 0.3, 0.1, 0.3]])),
        key_points_t=off, key_points_reference_t=torch.zeros(1, 4, 3), key_velocities_t=speed,
        key_velocities_reference_t=torch.zeros(1, 4, 3), hand_force_w=force, hand_push_w=torch.zeros(1, 2, 3),
        compliant_arms=torch.tensor([compliant]),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("forced", "compliant", "counted"),
    [
        ((False, False), (True, True), (1, 1)),
        ((True, False), (True, True), (0, 1)),
        ((True, True), (True, True), (0, 0)),
        ((True, True), (False, True), (1, 0)),
        ((True, True), (False, False), (1, 1)),
    ],
)
def test_a_compliant_arm_under_a_force_is_not_asked_to_be_at_its_reference(forced, compliant, counted):
    """Of such an arm nothing counts; of the other, all."""
    record = two_arms(forced, compliant)
    left, right = counted
    expected = {
        "track_arms": math.exp(-(0.01 * left + 0.09 * right) / 0.06),
        "track_key_points": math.exp(-(0.01 * left + (0.04 + 0.01) * right) / 0.01),
        "track_key_velocities": math.exp(-(1.0 * left + 4.0 * right)),
    }
    for name, value in expected.items():
        assert float(UpperRewards.TERMS[name].function(record)) == pytest.approx(value, rel=1e-5), name


AT_REST = {"velocity_h": [[0.0, 0.0]], "torso_linear_velocity_h": [[0.0, 0.0, 0.0]]}
# What each term gives when all is right.
BEST = {
    "track_velocity": 1.0, "track_velocity_closely": 1.0, "track_mean_velocity": 1.0, "track_mean_yaw_rate": 1.0,
    "track_yaw_rate": 1.0, "track_yaw_rate_closely": 1.0,
    "track_height": 1.0, "contact_schedule": 1.0, "alive": 1.0, "track_arms": 1.0,
    "reference_closeness": 1.0, "track_key_points": 1.0, "track_key_velocities": 1.0, "track_hands_as_facet": 1.0,
}  # fmt: skip
ALL_TERMS = sorted({f.name for group in (LowerRewards, UpperRewards) for f in dataclasses.fields(group)})


@pytest.mark.parametrize("name", ALL_TERMS)
def test_a_perfect_step(name):
    assert TERMS[name](perfect()).tolist() == [pytest.approx(BEST.get(name, 0.0), abs=1e-6)]


STANDING = {"stand": [1.0]}  # still moving at (0.5, -0.2) m/s: heading to a point (0.15, -0.06) m on
TURNED_IN = torch.tensor([[[math.cos(0.3), -math.sin(0.3), 0.0], [1.0, 0.0, 0.0]]])
OFF = {"key_points_t": [[[0.23, 0.24, 0.1], [0.2, -0.2, 0.1]]]}
PUSHED = {"hand_force_w": [[[0.0, 25.0, 0.0]]], "hand_push_w": [[[0.0, 25.0, 0.0]]],
          "torso_rotation_w": matrix_about_z(math.pi / 2)}  # fmt: skip
CASES = [
    ("track_velocity", {"torso_linear_velocity_h": [[0.2, 0.2, 0.0]]}, math.exp(-(0.09 + 0.16) / 0.25)),
    ("track_velocity", {"torso_linear_velocity_h": [[0.5, -0.2, 9.0]]}, 1.0),
    ("track_velocity_closely", {"velocity_h": [[0.6, -0.2]]}, math.exp(-0.01 / 0.04)),
    ("track_mean_velocity", {"mean_error": [[0.1, -0.05, 9.0]]}, 1.0 - (0.1 + 0.05) / 0.5),
    ("track_mean_velocity", {"mean_error": [[0.0, 0.9, 0.0]]}, 1.0 - 0.9 / 0.5),
    ("track_mean_velocity", {"mean_error": [[0.6, -0.7, 0.0]]}, -1.0),  # bounded
    ("track_mean_yaw_rate", {"mean_error": [[9.0, 9.0, -0.1]]}, 1.0 - 0.1 / 0.6),
    ("track_mean_yaw_rate", {"mean_error": [[0.0, 0.0, 1.3]]}, -1.0),
    ("track_yaw_rate", {"yaw_rate": [0.1]}, math.exp(-0.09)),
    ("track_yaw_rate_closely", {"yaw_rate": [0.3]}, math.exp(-0.01 / 0.06)),
    ("track_yaw_rate_closely", {"yaw_rate": [0.5]}, math.exp(-0.01 / 0.06)),
    ("track_height", {"torso_pos_w": [[3.0, -2.0, 0.96]]}, 1.0 - 0.04 / 0.15),
    ("track_height", {"torso_pos_w": [[3.0, -2.0, 1.03]]}, 1.0 - 0.03 / 0.15),
    ("track_height", {"torso_pos_w": [[3.0, -2.0, 0.6]]}, -1.0),
    # Standing 0.1 m behind the middle of the feet, heading to (0.05, -0.06) m of it.
    ("capture_point", {**STANDING, "torso_pos_w": [[2.9, -2.0, HEIGHT]]}, math.exp(-(0.05**2 + 0.06**2) / 0.01)),
    ("capture_point", {**STANDING, "heading_w": matrix_about_z(math.pi / 2)}, math.exp(-(0.06**2 + 0.15**2) / 0.01)),
    ("capture_point", {"torso_pos_w": [[2.9, -2.0, HEIGHT]]}, 0.0),
    # A torso that stands 0.05 m ahead of its feet by default is heading to 0.1 m ahead of where it belongs, not 0.15.
    (
        "capture_point",
        {**STANDING, "scales": dataclasses.replace(SCALES, torso_ahead_m=0.05)},
        math.exp(-(0.1**2 + 0.06**2) / 0.01),
    ),
    ("upright", {"projected_gravity_t": [[0.3, -0.4, -math.sqrt(0.75)]]}, 0.25),
    ("vertical_velocity", {"torso_linear_velocity_h": [[0.5, -0.2, -0.3]]}, 0.09),
    ("vertical_velocity", {"torso_linear_velocity_h": [[0.5, -0.2, -100.0]]}, 25.0),
    ("roll_pitch_rate", {"torso_angular_velocity_t": [[0.3, -0.4, 7.0]]}, 0.25),
    ("roll_pitch_rate", {"torso_angular_velocity_t": [[30.0, -600.0, 7.0]]}, 800.0),
    ("contact_schedule", {"foot_force": [[250.0, 4.9]]}, 0.5),
    ("contact_schedule", {"desired_contact": [[False, False]]}, 0.0),
    ("contact_schedule", {"foot_force": [[250.0, 0.0]], "desired_contact": [[True, False]]}, 1.0),
    # Half a metre a second off its command, a robot is asked for less.
    ("contact_schedule", {"torso_linear_velocity_h": [[0.2, 0.2, 0.0]]}, math.exp(-1.0)),
    ("swing_height", {**LEFT_LIFTED, "torso_linear_velocity_h": [[0.2, 0.2, 0.0]]}, 0.1 * math.exp(-1.0)),
    # Left foot in mid-swing should be 0.1 m up: it is on the floor, right, halfway, and too high.
    ("swing_height", LEFT_LIFTED, 0.1),
    ("swing_height", {**LEFT_LIFTED, "foot_pos_w": [[[3.0, -1.9, 0.1], [3.0, -2.1, 0.5]]]}, 0.0),
    ("swing_height", {**LEFT_LIFTED, "foot_pos_w": [[[3.0, -1.9, 0.05], [3.0, -2.1, 0.0]]]}, 0.05),
    ("swing_height", {**LEFT_LIFTED, "foot_pos_w": [[[3.0, -1.9, 0.15], [3.0, -2.1, 0.0]]]}, 0.05),
    # A quarter through the swing it should be half as high.
    ("swing_height", {"desired_contact": [[False, True]], "swing": [[0.25, 0.0]]}, 0.05),
    ("foot_slip", {"foot_velocity_w": [[[0.3, 0.4, 9.0], [0.0, -0.1, 0.0]]]}, 0.6),
    ("foot_slip", {"foot_velocity_w": [[[0.3, 0.4, 0.0], [0.0, -0.1, 0.0]]], "foot_force": [[0.0, 9.0]]}, 0.1),
    ("foot_flat", {"foot_up_w": [[[0.3, -0.4, 0.866], [0.0, 0.1, 0.995]]]}, 0.26),
    ("foot_yaw", {"foot_forward_w": TURNED_IN}, math.sin(0.3) ** 2),
    # Robot and feet turned together: nothing wrong. The robot alone: both feet are off by its angle.
    ("foot_yaw", {"heading_w": matrix_about_z(-0.3), "foot_forward_w": TURNED_IN[:, [0, 0]]}, 0.0),
    ("foot_yaw", {"heading_w": matrix_about_z(0.3)}, 2 * math.sin(0.3) ** 2),
    ("feet_apart", {"foot_pos_w": [[[3.0, -1.95, 0.0], [3.0, -2.05, 0.0]]]}, 0.08),
    ("feet_apart", {"foot_pos_w": [[[3.0, -2.05, 0.0], [3.0, -1.95, 0.0]]]}, 0.28),  # crossed
    ("feet_apart", {"foot_pos_w": [[[3.0, -2.5, 0.0], [3.0, -1.5, 0.0]]]}, 0.3),  # no worse than this
    ("feet_apart", {"foot_pos_w": [[[2.9, 0.0, 0.0], [3.1, 0.0, 0.0]]], "heading_w": matrix_about_z(math.pi / 2)}, 0.0),
    ("feet_apart", {"foot_pos_w": [[[3.1, 0.0, 0.0], [2.9, 0.0, 0.0]]], "heading_w": matrix_about_z(math.pi / 2)}, 0.3),
    ("hip_waist_deviation", {"joint_pos": [[0.3, 5.0, 5.0, 5.0, 5.0]]}, 0.04),
    ("stand_still", {"stand": [1.0], "joint_vel": [[1.0, 2.0, 0.0, 9.0, 9.0]]}, math.hypot(0.5, 0.2) + 0.05),
    ("stand_still", {"joint_vel": [[1.0, 2.0, 0.0, 9.0, 9.0]]}, 0.0),
    ("lower_torque", {"torque": [[1.0, -2.0, 3.0, 50.0, 50.0]]}, 14.0),
    ("upper_torque", {"torque": [[50.0, 50.0, 50.0, 2.0, -3.0]]}, 13.0),
    # The hand is 0.05 m off; a push of 25 N to the left meets a torso that faces left: it comes from behind.
    ("free_hand_error", OFF, 0.05),
    ("free_hand_error", {**OFF, "hand_force_w": [[[0.0, 0.0, -9.0]]]}, 0.0),
    ("free_hand_error", {**OFF, **PUSHED}, 0.0),
    ("loaded_hand_error", OFF, 0.0),
    ("loaded_hand_error", {**OFF, "hand_force_w": [[[0.0, 0.0, -9.0]]]}, 0.05),
    ("loaded_hand_error", {**OFF, **PUSHED, "hand_force_w": [[[0.0, 25.0, -9.0]]]}, 0.0),
    ("push_resistance", PUSHED, 25.0),
    ("push_resistance", {**PUSHED, **OFF}, 25.0 - 150.0 * 0.03),
    ("push_resistance", {**PUSHED, **OFF, "torso_rotation_w": torch.eye(3)[None]}, 25.0 - 150.0 * 0.04),
    ("push_resistance", {**PUSHED, "key_points_t": [[[0.9, 0.2, 0.1], [0.2, -0.2, 0.1]]]}, 0.0),
    ("push_resistance", {**PUSHED, "hand_force_w": [[[0.0, 25.0, -9.0]]]}, 0.0),
    ("lower_acceleration", {"joint_acceleration": [[1.0, -2.0, 3.0, 50.0, 50.0]]}, 14.0),
    ("upper_acceleration", {"joint_acceleration": [[50.0, 50.0, 50.0, 2.0, -3.0]]}, 13.0),
    ("lower_action_rate", {"action": [[1, 2, 3, 9, 9.0]], "last_action": [[2, 2, 1, 0, 0.0]]}, 5.0),
    ("upper_action_rate", {"action": [[9, 9, 9, 1, -1.0]], "last_action": [[0, 0, 0, 2, 2.0]]}, 10.0),
    ("lower_joint_limits", {"joint_pos": [[-0.7, 0.6, 0.5, 9.0, -9.0]]}, 0.3),
    ("upper_joint_limits", {"joint_pos": [[9.0, -9.0, 9.0, 0.7, -0.6]]}, 0.3),
    ("reference_closeness", {"arm_target": [[0.3, 0.0]], "position": [[0.0, 0.4]]}, math.exp(-2.0 * 0.5)),
    ("arm_target_offset", {"arm_target": [[0.3, 0.0]], "position": [[0.0, 0.4]]}, 0.25),
    ("alive", {"fell": [True]}, 0.0),
    ("fall", {"fell": [True]}, 1.0),
    ("track_arms", {"joint_pos": [[9.0, 9.0, 9.0, 0.1, -0.2]]}, math.exp(-0.05 / 0.06)),
    ("track_arms", {"joint_pos": [[0, 0, 0, 0.3, -0.1]], "position": [[0.2, 0.1]]}, math.exp(-0.05 / 0.06)),
    ("track_key_points", {"key_points_t": [[[0.2, 0.2, 0.2], [0.2, -0.1, 0.1]]]}, math.exp(-0.02 / 0.01)),
    ("track_key_velocities", {"key_velocities_t": [[[0.5, 0, 0], [0, -1.0, 0]]]}, math.exp(-1.25)),
    # The torso turns at 0.4 rad/s about z and the hand is 0.5 m too far in front: it is 0.2 m/s too fast to the left.
    ("track_key_velocities", {"key_points_t": [[[0.7, 0.2, 0.1], [0.2, -0.2, 0.1]]]}, math.exp(-0.04)),
    # What it is too fast for that, it is slower on the torso.
    (
        "track_key_velocities",
        {"key_points_t": [[[0.7, 0.2, 0.1], [0.2, -0.2, 0.1]]], "key_velocities_t": [[[0, -0.2, 0], [0, 0, 0.0]]]},
        1.0,
    ),
    (
        "track_key_velocities",
        {"key_velocities_t": [[[0.3, 0, 0], [0, 0, 0.0]]], "key_velocities_reference_t": [[[-0.2, 0, 0], [0, 0, 0.0]]]},
        math.exp(-0.25),
    ),
    # One hand, one elbow: FACET judges the hand.
    ("track_hands_as_facet", {"key_points_t": [[[0.2, 0.2, 0.4], [9.0, -0.1, 0.1]]]}, math.exp(-0.09)),
    ("track_hands_as_facet", {"key_velocities_t": [[[0.5, 0, 0], [0, -1.0, 0]]]}, math.exp(-0.25)),
    (
        "track_hands_as_facet",
        {"key_points_t": [[[0.2, 0.2, 0.4], [0.2, -0.2, 0.1]]], "key_velocities_t": [[[0, 0.4, 0], [0, 0, 0.0]]]},
        math.exp(-0.09 - 0.16),
    ),
]  # fmt: skip


@pytest.mark.parametrize(("name", "changes", "expected"), CASES)
def test_by_hand(name, changes, expected):
    assert TERMS[name](changed(**changes)).tolist() == [pytest.approx(expected, abs=1e-5)]


def test_every_term_has_a_case_by_hand():
    assert {name for name, _, _ in CASES} == set(ALL_TERMS)


def test_what_is_asked_of_laws_has_no_penalty():
    """It comes behind the five joints."""
    asked = dataclasses.replace(
        perfect(), action=torch.tensor([[9, 9, 9, 1, -1, 7.0]]), last_action=torch.tensor([[0, 0, 0, 2, 2, 0.0]])
    )
    assert TERMS["upper_action_rate"](asked).tolist() == [10.0]
    assert TERMS["lower_action_rate"](asked).tolist() == [243.0]


@pytest.mark.parametrize("weights", [LowerRewards(), UpperRewards()], ids=["lower", "upper"])
@pytest.mark.parametrize("changes", [changes for _, changes, _ in CASES])
def test_no_fault_pays(weights, changes):
    """With the default weights: a weight of the wrong sign would pay for a fault."""
    group = RewardGroup("group", weights, DT)
    _, best = group(changed(stand=changes.get("stand", [0.0]), **AT_REST))
    _, terms = group(changed(**changes))
    assert (terms <= best + 1e-9).all()


@pytest.mark.parametrize("cls", [LowerRewards, UpperRewards])
def test_every_field_is_a_function_and_weights_it(cls):
    for field in dataclasses.fields(cls):
        weights = cls(**{f.name: 0.0 for f in dataclasses.fields(cls)})
        setattr(weights, field.name, 3.0)
        group = RewardGroup("only", weights, DT)
        assert list(group.terms) == [field.name]
        record = changed(fell=[True], stand=[1.0], torso_linear_velocity_h=[[0.1, 0.1, 0.1]])
        value = float(TERMS[field.name](record))
        once = field.name == "fall"
        total, terms = group(record)
        assert total.tolist() == [pytest.approx(3.0 * value * (1.0 if once else DT), abs=1e-7)]
        assert torch.equal(terms[0], total)


def test_the_sum_of_the_terms_is_the_reward():
    record = changed(torque=[[1.0, -2.0, 3.0, 50.0, 50.0]], torso_linear_velocity_h=[[0.2, 0.2, 0.4]])
    group = RewardGroup("lower", LowerRewards(), DT)
    total, terms = group(record)
    weights = dataclasses.asdict(LowerRewards())
    expected = [weights[name] * (1.0 if name == "fall" else DT) * float(TERMS[name](record)) for name in group.terms]
    assert terms.squeeze(1).tolist() == pytest.approx(expected, abs=1e-6)
    assert total.tolist() == [pytest.approx(sum(expected), abs=1e-6)]
    assert len({abs(value) for value in expected if value != 0.0}) > 5  # in another order they would differ


def test_weights_must_be_finite():
    with pytest.raises(ValueError, match=r"rewards\.lower\.upright must be a finite number, got nan"):
        RewardGroup("lower", LowerRewards(upright=math.nan), DT)


def test_facets_reward_is_the_mean_over_hands():
    """By hand, two hands and two elbows: the mean of the kernels, not the kernel of the mean."""
    zero = torch.zeros(1, 4, 3)
    points = torch.tensor([[[0.3, 0.0, 0.0], [0.0, 0.0, 0.0], [9.0, 0.0, 0.0], [9.0, 0.0, 0.0]]])
    speeds = torch.tensor([[[0.0, 0.0, 0.0], [0.0, -2.0, 0.0], [9.0, 0.0, 0.0], [9.0, 0.0, 0.0]]])
    record = dataclasses.replace(
        perfect(), key_points_t=points, key_points_reference_t=zero, key_velocities_t=speeds,
        key_velocities_reference_t=zero,
    )  # fmt: skip
    expected = 0.5 * (math.exp(-0.09) + math.exp(-4.0))
    assert float(TERMS["track_hands_as_facet"](record)) == pytest.approx(expected, abs=1e-6)


def test_a_term_is_declared_once_and_all_follows():
    """Field, default weight, help and function of a group that is made here."""

    @reward_group
    class Own:
        @term(2.0)
        def height(s: StepRecord) -> torch.Tensor:
            """How high it is."""
            return s.state.height

        @term(-3.0, once=True)
        def over(s: StepRecord) -> torch.Tensor:
            """Whether it is over."""
            return s.fell.float()

        @term(0.0)
        def off(s: StepRecord) -> torch.Tensor:
            """Never asked."""
            raise AssertionError

    assert dataclasses.asdict(Own()) == {"height": 2.0, "over": -3.0, "off": 0.0}
    group = RewardGroup("own", Own(height=5.0), DT)
    total, terms = group(changed(fell=[True]))
    assert list(group.terms) == ["height", "over"]
    assert terms.squeeze(1).tolist() == pytest.approx([5.0 * DT * HEIGHT, -3.0])
    assert total.tolist() == pytest.approx([5.0 * DT * HEIGHT - 3.0])
    assert "How high it is." in str(Own.__annotations__["height"])


def test_every_term_says_what_it_is():
    for group in GROUPS:
        for name, declared in group.TERMS.items():
            assert (declared.function.__doc__ or "").strip().endswith("."), name


def test_scales_follow_the_robot(any_spec):
    scales = RobotScales.of(any_spec)
    assert scales.num_lower == len(any_spec.lower_joints)
    for i, joint in enumerate(any_spec.joints):
        low, high = joint.range_rad
        margin = 0.025 * (high - low)  # a twentieth of the range in all
        assert float(scales.joint_low[i]) == pytest.approx(low + margin, abs=1e-5)
        assert float(scales.joint_high[i]) == pytest.approx(high - margin, abs=1e-5)
        assert float(scales.default_position[i]) == pytest.approx(joint.default_rad)


def test_scales_by_hand(any_spec):
    scales = RobotScales.of(any_spec)
    hips = ("left_hip_roll", "left_hip_yaw", "right_hip_roll", "right_hip_yaw", "waist_yaw", "waist_roll")
    sideways = {
        "h1": ("left_hip_yaw", "left_hip_roll", "right_hip_yaw", "right_hip_roll", "torso"),
        "g1": tuple(f"{name}_joint" for name in hips),
        "made-up": hips,
    }
    assert tuple(any_spec.joint_names[i] for i in scales.hip_waist) == sideways[any_spec.name]
    # Soles of the made-up robot are 2 * (0.07 + 0.03) m apart.
    distance = {"h1": 0.45 * any_spec.sole_distance_m, "g1": 0.45 * 0.237013, "made-up": 0.45 * 0.2}
    assert scales.foot_distance_m == pytest.approx(distance[any_spec.name], abs=1e-6)
    clearance = {"h1": 0.071435, "g1": 0.05800893, "made-up": 0.056196}
    assert scales.foot_clearance_m == pytest.approx(clearance[any_spec.name], abs=1e-6)
    assert 0.1 < RobotScales.of(any_spec).foot_distance_m / 0.45 < 0.5


def test_a_standing_robot_pays_for_nothing_of_its_shape(make_env, robot):
    """In its default pose, feet where they belong, no term that depends on a robot's sizes finds a fault."""
    env = make_env(2, robot=robot)
    env.commands.override(torch.zeros(2, 2), torch.zeros(2), torch.ones(2), torch.full((2,), env.spec.nominal_height_m))
    env.motions.hold(env.motions.default)
    env.reset()
    pose = env.joint_targets.default.repeat(2, 1)
    base = torch.tensor([0.0, 0.0, env.spec.base_height_m, 1.0, 0.0, 0.0, 0.0]).repeat(2, 1)
    speed = torch.zeros(2, env.sim.qvel.shape[1]).double()
    env.sim.reset(torch.ones(2, dtype=torch.bool), torch.cat((base, pose), 1).double(), speed)
    env.actuation.reset(torch.ones(2, dtype=torch.bool), pose)
    env.state = env.reader.read()
    env.step(torch.zeros(2, env.num_actions))
    value = {name: float(function(env.record).mean()) for name, function in TERMS.items()}
    for name in ("feet_apart", "lower_joint_limits", "upper_joint_limits"):
        assert value[name] == 0.0, name
    for name in ("hip_waist_deviation", "foot_yaw", "foot_flat", "upright", "arm_target_offset"):
        assert value[name] < 0.01, name
    for name in ("track_height", "track_arms", "track_key_points", "contact_schedule"):
        assert value[name] > 0.9, name
