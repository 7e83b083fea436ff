"""What the page asks for is what the simulation does."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
import torch
from random_policy import save_random_policy

from cotap.compliance.laws import LAWS
from cotap.envs.rewards import LowerRewards, RewardGroup, UpperRewards
from cotap.play.forces import Push
from cotap.play.sample import effective_stiffness
from cotap.play.session import Session

LEFT, RIGHT = 0, 1


def run(session, steps):
    return [session.step() for _ in range(steps)]


def test_robots_start_alike_face_forward_and_stay_alike_under_the_same_push(session):
    session.push(Push("left", (40.0, 0.0, 0.0), 0.2))
    samples = run(session, 25)
    for name in ("qpos", "hand_error", "arm_torque"):
        a, b = np.array([s[name] for s in samples]).transpose(1, 0, *range(2, samples[0][name].ndim + 1))
        np.testing.assert_allclose(a, b, atol=1e-5, err_msg=name)
    assert samples[0]["heading_w"][0, 0, 0] > 0.99
    session.reset()
    session.push(Push("left", (40.0, 0.0, 0.0), 0.2))
    np.testing.assert_allclose(run(session, 25)[-1]["qpos"], samples[-1]["qpos"], atol=1e-6)


def test_law_and_stiffness_are_set_per_robot_and_arm(session):
    assert session.set({"a.left.law": "pd", "b.right.stiffness_z": 900.0, "b.right.alpha": 0.5}) == []
    sample = run(session, 3)[-1]
    commanded = sample["commanded_stiffness"]
    assert np.isnan(commanded[0, LEFT]).all()  # PD commands no stiffness of the hand
    assert commanded[0, RIGHT].tolist() == [300.0, 300.0, 300.0]
    assert commanded[1, RIGHT].tolist() == [300.0, 300.0, 900.0]
    kp = session.env.spec.joints[-1].kp
    np.testing.assert_allclose(sample["stiffness_eigenvalues"][0, LEFT], kp, rtol=1e-4)
    np.testing.assert_allclose(np.diag(sample["effective_stiffness"][1, LEFT]), 300.0, rtol=0.02)
    assert session.env.upper_body.parameters.alpha.tolist() == [[1.0, 1.0], [1.0, 0.5]]


def test_the_softer_robot_gives_way_further_to_the_same_load(session):
    session.set({f"b.left.stiffness_{axis}": 900.0 for axis in "xyz"} | {"arm_actions": False, "held.left.z": -12.0})
    samples = run(session, 60)
    offset = np.array([s["hand_w"][:, LEFT, 2] - s["hand_reference_w"][:, LEFT, 2] for s in samples])[-10:].mean(0)
    force = samples[-1]["hand_force_w"][:, LEFT]
    np.testing.assert_allclose(force, [[0.0, 0.0, -12.0]] * 2, atol=1e-5)
    # -12 N over 300 and over 900 N/m; what else is off is the same for both.
    assert offset[0] - offset[1] == pytest.approx(-12.0 / 300.0 + 12.0 / 900.0, abs=0.006)


def test_commands_reach_the_robots_and_standing_ends_them(session):
    session.set({"velocity_x": 0.6, "stand": False, "yaw_rate": -0.3, "height_offset": -0.1})
    run(session, 40)
    command = session.env.commands.current()
    assert command.velocity_h.tolist() == pytest.approx(np.array([[0.6, 0.0]] * 2))
    assert command.yaw_rate.tolist() == pytest.approx([-0.3] * 2)
    assert command.stand.tolist() == [0.0] * 2
    assert command.height.tolist() == pytest.approx([session.env.spec.nominal_height_m] * 2)  # no squat that walks
    session.set({"stand": True})
    run(session, 25)
    assert session.env.commands.asked_to_stand.all()
    assert session.env.commands.current().velocity_h.abs().max() == 0.0
    height = session.env.commands.current().height
    assert height.tolist() == pytest.approx([session.env.spec.nominal_height_m - 0.1] * 2)


def test_motion_is_led_and_comes_back(session):
    name = session.controls["motion"].options[1]
    session.set({"motion": name})
    moving = run(session, 60)
    assert np.abs(np.diff([s["hand_reference_w"][0, LEFT] for s in moving], axis=0)).max() > 1e-3
    session.set({"motion": "rest"})
    run(session, 150)
    env = session.env
    assert torch.allclose(env.motions.current().position, env.motions.default.expand(2, -1), atol=1e-4)


def test_domain_is_set_per_robot(session):
    nominal = torch.from_numpy(session.env.sim.model.body_mass)
    session.set({"a.friction": 0.4, "b.mass_scale": 1.2, "b.load_kg": 5.0})
    mass = session.env.sim.field("body_mass")
    assert torch.allclose(mass[0], nominal)
    assert float(mass[1].sum()) == pytest.approx(1.2 * float(nominal.sum()) + 5.0, rel=1e-6)
    sliding = session.env.sim.field("geom_friction")[:, :, 0]
    assert torch.isclose(sliding[0], torch.tensor(0.4).double()).sum() == (sliding[0] != sliding[1]).sum() > 0


def test_a_checkpoint_that_cannot_be_used_is_put_back_and_a_notice_says_so(session):
    before = session._policies[1]
    (notice,) = session.set({"b.checkpoint": "missing"})
    assert "nowhere.pt" in notice
    assert session.values["b.checkpoint"] == "base"
    assert session._policies[1] is before


def test_a_fallen_robot_is_back_on_its_feet_and_counted(session):
    falls = list(session.falls)
    before = session.step()
    session.env.sim.qpos[1, 2:7] = torch.tensor([0.6, 0.5**0.5, 0.0, 0.5**0.5, 0.0])  # on its face
    sample = session.step()
    assert sample["fell"].tolist() == [False, True]
    for name in sample.keys() - {"fell"}:  # of the fallen one the step before is shown
        np.testing.assert_array_equal(sample[name][1], before[name][1])
    assert (sample["qpos"][0] != before["qpos"][0]).any()
    assert [b - a for a, b in zip(falls, session.falls, strict=True)] == [0, 1]
    sample = session.step()
    assert sample["height"][1] > 0.9
    assert sample["heading_w"][1, 0, 0] > 0.99


def test_a_robot_whose_simulation_diverged_is_shown_as_it_was(session):
    before = session.step()
    session.env.sim.qvel[1] = 1e12
    sample = session.step()
    assert sample["fell"].tolist() == [False, True]
    np.testing.assert_array_equal(sample["hand_w"][1], before["hand_w"][1])
    for name in ("hand_w", "qpos", "velocity", "effective_stiffness", "stiffness_eigenvalues"):
        assert np.isfinite(sample[name]).all(), name


def test_a_recording_names_the_policy_that_runs_though_its_file_is_gone(tmp_path):
    path = save_random_policy(tmp_path / "p.pt")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    session = Session({"mine": path})
    path.unlink()
    assert session.describe()["checkpoints_sha256"] == {"a": digest, "b": digest}


def test_effective_stiffness_against_the_closed_form_of_a_square_jacobian():
    rng = torch.Generator().manual_seed(1)
    jacobian = torch.randn(5, 3, 3, generator=rng, dtype=torch.float64)
    root = torch.randn(5, 3, 3, generator=rng, dtype=torch.float64)
    stiffness = root @ root.transpose(1, 2) + 10.0 * torch.eye(3)
    inverse = torch.linalg.inv(jacobian)
    expected = inverse.transpose(1, 2) @ stiffness @ inverse
    expected = torch.linalg.inv(torch.linalg.inv(expected) + 1e-6 * torch.eye(3))
    assert torch.allclose(effective_stiffness(jacobian, stiffness).double(), expected, rtol=1e-4)


def test_along_a_straight_arm_the_effective_stiffness_is_finite():
    jacobian = torch.tensor([[0.3, 0.2, 0.1, 0.1], [0.0, 0.1, 0.2, 0.0], [0.0, 0.0, 0.0, 0.0]])
    stiffness = effective_stiffness(jacobian, 100.0 * torch.eye(4))
    assert torch.isfinite(stiffness).all()
    assert float(stiffness[2, 2]) == pytest.approx(1e6, rel=1e-3)


def test_robots_move_alike_whether_or_not_rewards_are_computed(checkpoint):
    one, other = (Session({"base": checkpoint}) for _ in range(2))
    assert [list(group.terms) for group in one.env._groups] == [["alive"], ["alive"]]
    other.env._groups = (
        RewardGroup("lower", LowerRewards(), other.dt), RewardGroup("upper", UpperRewards(), other.dt)
    )  # fmt: skip
    for a, b in zip(run(one, 20), run(other, 20), strict=True):
        np.testing.assert_array_equal(a["qpos"], b["qpos"])


def test_stiffness_stays_what_was_set_under_a_policy_that_was_trained_with_all(tmp_path):
    """Its training draws parameters of laws at every start, and again within episodes."""
    session = Session({"cotap": save_random_policy(tmp_path / "cotap.pt", "distill")})
    assert session.set({"a.left.stiffness_x": 1200.0, "b.right.alpha": 0.25}) == []
    session.reset()
    for _ in range(2):
        session.step()
    parameters = session.env.upper_body.parameters
    assert parameters.stiffness[:, :, 0].tolist() == [[1200.0, 300.0], [300.0, 300.0]]
    assert parameters.alpha.tolist() == [[1.0, 1.0], [1.0, 0.25]]


@pytest.mark.parametrize("robot", ["g1", "made-up"])
def test_a_robot_with_other_arms_has_all_laws(robot, tmp_path):
    session = Session({"base": save_random_policy(tmp_path / "base.pt", robot=robot)})
    law = session.controls["a.left.law"]
    assert law.options == tuple(LAWS)
    assert session.set({"a.left.law": "pd", "motion": "rest"}) == []
    assert session.set({"a.left.law": "cotap", "b.left.law": "pd", "arm_actions": False}) == []
    session.push(Push("left", (20.0, 0.0, 0.0), 0.2))
    sample = run(session, 3)[-1]
    assert sample["arm_torque"].shape == (2, 14)
    np.testing.assert_allclose(np.linalg.norm(sample["hand_force_w"][:, LEFT], axis=-1), 20.0, rtol=1e-4)
    assert np.isnan(sample["commanded_stiffness"][1, LEFT]).all()
    np.testing.assert_allclose(np.diag(sample["effective_stiffness"][0, LEFT]), 300.0, rtol=0.05)
    assert sample["qpos"].shape == (2, 7 + len(session.env.spec.joints))


def test_an_arm_is_made_passive_and_its_store_is_shown(session):
    assert session.set({"a.left.passive": True, "b.left.passive": True, "b.left.law": "pd"}) == []
    assert session.env.upper_body.report == {}
    sample = run(session, 3)[-1]
    assert np.isfinite(sample["store_energy"]).tolist() == [[True, False], [False, False]]
    assert sample["store_energy"][0, LEFT] == pytest.approx(2.0)
    assert sample["held_back"][0, LEFT] == 0.0
    session.set({"a.left.law": "pd"})
    assert np.isnan(run(session, 1)[-1]["store_energy"]).all()
    assert session.set({"b.left.law": "cotap"}) == []
    assert np.isfinite(run(session, 1)[-1]["store_energy"][1, LEFT])
