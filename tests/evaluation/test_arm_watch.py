"""How near to singular arms are, and where their compliance lies: against singular vectors, by hand, in a rollout."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cotap.compliance.fast import blended_stiffness
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.evaluation.arm_watch import ArmWatch, condition_number, null_share
from cotap.evaluation.disturbance import Impact
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.rollout import idle


def jacobians(joints: int, count: int = 50) -> torch.Tensor:
    return torch.randn(count, 3, joints, generator=torch.Generator().manual_seed(joints))


@pytest.mark.parametrize("joints", [4, 7])
def test_the_share_is_that_of_the_directions_that_leave_the_hand_where_it_is(joints):
    j, root = jacobians(joints), torch.randn(50, joints, joints, generator=torch.Generator().manual_seed(1))
    stiffness = root @ root.transpose(-1, -2) + 0.5 * torch.eye(joints)
    for one, k, share in zip(j.double().numpy(), stiffness.double().numpy(), null_share(j, stiffness), strict=True):
        null, compliance = np.linalg.svd(one)[2][3:], np.linalg.inv(k)
        assert float(share) == pytest.approx(np.trace(null @ compliance @ null.T) / np.trace(compliance), rel=1e-5)


@pytest.mark.parametrize("joints", [4, 7])
def test_under_gains_that_are_equal_it_is_that_of_the_joints(joints):
    gains = 40.0 * torch.eye(joints).expand(50, -1, -1)
    torch.testing.assert_close(null_share(jacobians(joints), gains), torch.full((50,), (joints - 3) / joints))


def test_under_compliance_it_is_that_of_the_null_stiffness():
    """Joints that yield by J# J#^T / K for the hand's sake, and by 1 / k_null in each direction of the null space."""
    j, hand, null = jacobians(7).double(), 100.0, 25.0
    task = torch.full((50, 3), hand, dtype=torch.float64)
    blend = blended_stiffness(j, task, torch.full((50,), null), torch.full((50,), 40.0), torch.ones(50), 1e9)
    inverse = torch.linalg.pinv(j)
    of_hand, of_null = inverse.square().sum((-1, -2)) / hand, 4.0 / null
    torch.testing.assert_close(
        null_share(j, blend.stiffness).double(), of_null / (of_null + of_hand), rtol=1e-5, atol=0
    )


def test_condition_numbers_are_those_of_singular_values_up_to_fifty():
    j = jacobians(7)
    j[0, 2] = 1e-4 * j[0, 0] + j[0, 1]  # a straight arm
    j[1, 2] = j[1, 1]
    expected = np.linalg.cond(j.double().numpy())
    assert expected[0] > 1000.0
    np.testing.assert_allclose(condition_number(j), np.minimum(expected, 50.0), rtol=1e-5)


def watched(law: str, steps: int = 4) -> tuple[ArmWatch, list[tuple[torch.Tensor, torch.Tensor]], HumanoidEnv]:
    """A watch over two envs whose arms swing, and the Jacobian and stiffness of every step."""
    cfg = HumanoidEnvConfig(num_envs=2, num_threads=1, fixed_base=True)
    cfg.upper_body = LawOptions(method=law).configure()
    env = HumanoidEnv(cfg)
    watch, seen, act = ArmWatch(), [], idle(env)
    for step in range(steps + 2):
        watch.see(env, step, range(1, 1 + steps))
        before = env.state.arms
        env.step(act({}))
        seen.append((env.upper_body.arms.chains.jacobian(before), env.arm_stiffness()))
    return watch, seen[1 : 1 + steps], env


@pytest.mark.parametrize("law", ["pd", "cotap"])
def test_arms_are_seen_with_the_stiffness_that_their_law_gives_them_there(law):
    watch, seen, _ = watched(law)
    m = watch.measures(torch.ones(4, 2, dtype=torch.bool), [0], "_left")
    condition = np.array([np.linalg.cond(j[:, 0].double().numpy()) for j, _ in seen]).clip(max=50.0)
    np.testing.assert_allclose(m["condition_number_left"], condition.mean(0), rtol=1e-4)
    np.testing.assert_allclose(m["singular_share_left"], (condition > 10.0).mean(0))
    expected = torch.stack([null_share(j[:, 0], k[:, 0]) for j, k in seen])
    torch.testing.assert_close(m["null_share_left"], expected.mean(0))
    if law == "pd":
        assert m["null_share_left"].tolist() == pytest.approx([0.25] * 2, abs=0.03)  # gains are randomised


def test_what_follows_a_fall_does_not_count_and_both_arms_are_averaged():
    watch, seen, _ = watched("cotap")
    alive = torch.tensor([[True, False], [True, False], [False, False], [False, False]])
    m = watch.measures(alive, [0, 1])
    condition = torch.stack([condition_number(j) for j, _ in seen])
    assert float(m["condition_number"][0]) == pytest.approx(float(condition[:2, 0].mean()), rel=1e-5)
    assert m["null_share"][1].isnan()
    assert ArmWatch().measures(alive, [0]) == {}


def test_without_the_ratio_no_arm_is_above_its_threshold():
    watch, _, env = watched("cotap")
    env.cfg.upper_body.singularity_ratio = False
    watch.see(env, 1, range(1, 2))
    watch.see(env, 2, range(1, 2))
    assert float(watch.measures(torch.ones(1, 2, dtype=torch.bool), [0])["singular_share"].sum()) == 0.0


def test_a_push_is_measured_with_it():
    short = {"onset": 0.5, "window": (0.0, 0.1), "fall_seconds": 0.1, "episode_seconds": 0.6}
    protocol = Impact(num_envs=1, pelvis="fixed", randomize=False, **short)
    env = HumanoidEnv(protocol.configure(HumanoidEnvConfig(num_threads=1)))
    protocol.prepare(env)
    measured = protocol.evaluate(env, idle(env))
    assert measured["metrics"]["null_share"]["mean"] == pytest.approx(0.25, abs=1e-4)
    assert {"condition_number", "singular_share"} <= measured["metrics_without_falls"].keys()
