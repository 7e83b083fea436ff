"""Step timing: the gait clock jumps where that lowers the chance of a fall, and mirror images jump alike."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from cotap.agents.actors import as_dict
from cotap.envs import H1Env, H1EnvConfig, step_timing
from cotap.envs.commands import HURRY, Catch, CommandConfig, CommandSource
from cotap.envs.step_timing import (
    BINS,
    CORRECTION_GAIN,
    GAIN,
    HURRY_S,
    REST_S,
    StepTiming,
    feature_reflection,
    features,
    risk_at,
)
from cotap.evaluation.disturbance import Impact
from cotap.evaluation.policy import load_policy, shipped_checkpoint
from cotap.robots import ROBOTS

DT = 0.02


@pytest.fixture(scope="module")
def env() -> H1Env:
    cfg = H1EnvConfig(num_envs=16, num_threads=1)
    env = H1Env(cfg)
    for _ in range(5):
        env.step(torch.randn(16, env.num_actions, generator=torch.Generator().manual_seed(0)))
    return env


def timing(num_envs: int) -> StepTiming:
    return StepTiming(ROBOTS["h1"](), num_envs, DT)


def test_risk_between_points_is_linear_and_wraps() -> None:
    risk = torch.zeros(3, BINS + 1)
    risk[:, 0], risk[:, 1], risk[:, BINS - 1], risk[:, BINS] = 0.2, 0.6, 0.4, 9.0
    phase = torch.tensor([0.0, 0.25 / BINS, (BINS - 0.5) / BINS])
    torch.testing.assert_close(risk_at(risk, phase), torch.tensor([0.2, 0.3, 0.3]))


def test_mirror_images_are_judged_alike_half_a_stride_on(env: H1Env) -> None:
    timing_ = timing(16)
    x = features(env.state, env.commands.current(), timing_._default)
    mirror = feature_reflection(env.spec)
    risk, mirrored = (timing_.model(v).sigmoid().detach() for v in (x, mirror(x)))
    torch.testing.assert_close(mirror(mirror(x)), x)
    torch.testing.assert_close(mirrored[:, :BINS], risk[:, :BINS].roll(BINS // 2, 1), rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(mirrored[:, BINS], risk[:, BINS], rtol=1e-4, atol=1e-6)
    assert risk.std() > 0.0


def test_features_mirror_as_the_observation_does(env: H1Env) -> None:
    """The environment's own reflection, tested against physics elsewhere, is the oracle."""
    own = env.symmetry.observations["policy"]
    observed = env.get_observations()["policy"]
    steps = env.history.steps
    offsets, start = {}, 0
    for name, width, _ in env.history.terms:
        offsets[name] = slice(start + width * (steps - 1), start + width * steps)
        start += width * steps

    def seen(x: torch.Tensor) -> torch.Tensor:
        names = ("projected_gravity", "torso_angular_velocity", "joint_position", "joint_velocity", "command_velocity",
                 "command_yaw_rate")  # fmt: skip
        return torch.cat([x[:, offsets[n]] for n in names], 1)

    torch.testing.assert_close(feature_reflection(env.spec)(seen(observed)), seen(own(observed)))


@pytest.fixture
def judged(monkeypatch: pytest.MonkeyPatch) -> StepTiming:
    """A timing whose risks the test sets as `risk_now` (N, BINS + 1)."""
    timing_ = timing(16)
    monkeypatch.setattr(timing_, "risk", lambda *_: timing_.risk_now, raising=False)  # pyright: ignore[reportAttributeAccessIssue]
    return timing_


def test_jumps_only_for_a_gain_and_not_again_at_once(env: H1Env, judged: StepTiming) -> None:
    command = dataclasses.replace(env.commands.current(), stand=torch.zeros(16), phase=torch.full((16,), 3 / BINS))
    nobody = torch.zeros(16, dtype=torch.bool)
    risk = torch.full((16, BINS + 1), 0.5)
    risk[:8, 20] = 0.5 - GAIN - 0.01
    risk[8:, 20] = 0.5 - GAIN + 0.01
    judged.risk_now = risk  # pyright: ignore[reportAttributeAccessIssue]
    catch = judged.step(env.state, command, nobody)
    assert catch.jumps.tolist() == [True] * 8 + [False] * 8
    torch.testing.assert_close(catch.phase[:8], torch.full((8,), 20 / BINS))
    assert catch.hurries.tolist() == [True] * 8 + [False] * 8
    steps = 0
    while not (catch := judged.step(env.state, command, nobody)).jumps[0]:
        assert catch.hurries[0]
        steps += 1
    assert steps == pytest.approx(REST_S / DT, abs=2)
    judged.risk_now = torch.full((16, BINS + 1), 0.5)  # pyright: ignore[reportAttributeAccessIssue]
    hurried = 0
    while judged.step(env.state, command, nobody).hurries[0]:
        hurried += 1
    assert hurried == pytest.approx(HURRY_S / DT, abs=2)


@pytest.mark.parametrize(("correct_s", "corrections"), [(0.0, 0), (0.1, 5)])
def test_a_jump_is_corrected_for_a_while_and_for_less(env, judged, correct_s: float, corrections: int) -> None:
    """The first jump asks for a gain, corrections for less of one; what is left of the time counts from the first."""
    judged._correct_s = correct_s
    walking = dataclasses.replace(env.commands.current(), stand=torch.zeros(16), phase=torch.full((16,), 3 / BINS))
    standing = dataclasses.replace(walking, stand=torch.ones(16))
    nobody = torch.zeros(16, dtype=torch.bool)
    judged.risk_now = torch.full((16, BINS + 1), 0.5)
    judged.risk_now[:, 20] = 0.5 - GAIN - 0.01
    assert judged.step(env.state, walking, nobody).jumps.all()
    judged.risk_now = torch.full((16, BINS + 1), 0.5)
    judged.risk_now[:8, 9] = 0.5 - CORRECTION_GAIN - 0.01
    judged.risk_now[8:, 9] = 0.5 - CORRECTION_GAIN + 0.01
    assert not judged.step(env.state, standing, nobody).jumps.any()
    catches = [judged.step(env.state, walking, nobody) for _ in range(12)]
    assert [bool(c.jumps[0]) for c in catches] == [True] * max(corrections - 1, 0) + [False] * (
        12 - max(corrections - 1, 0)
    )
    assert not torch.stack([c.jumps[8:] for c in catches]).any()
    if corrections:
        torch.testing.assert_close(catches[0].phase[:8], torch.full((8,), 9 / BINS))


def test_rest_counts_from_the_last_correction(env, judged) -> None:
    judged._correct_s = 0.1
    command = dataclasses.replace(env.commands.current(), stand=torch.zeros(16), phase=torch.full((16,), 3 / BINS))
    nobody = torch.zeros(16, dtype=torch.bool)
    judged.risk_now = torch.full((16, BINS + 1), 0.5)
    judged.risk_now[:, 20] = 0.2
    jumps = [bool(judged.step(env.state, command, nobody).jumps[0]) for _ in range(30)]
    series = round(0.1 / DT) + 1
    assert jumps[:series] == [True] * series
    again = jumps.index(True, series)
    assert again - (series - 1) == pytest.approx(REST_S / DT, abs=2)


def test_states_saved_before_jumps_were_corrected_are_taken() -> None:
    timing_ = timing(3)
    timing_.load_state_dict({"_since_s": torch.tensor([0.0, 0.3, math.inf])})
    assert timing_._since_first_s.tolist() == timing_._since_s.tolist()
    with pytest.raises(ValueError, match="_since_s"):
        timing_.load_state_dict({})


def test_a_standing_robot_is_judged_by_standing_on_and_must_step_when_it_leans(env: H1Env, judged: StepTiming) -> None:
    command = dataclasses.replace(env.commands.current(), stand=torch.ones(16), phase=torch.zeros(16))
    risk = torch.full((16, BINS + 1), 0.5)
    risk[:, 7], risk[:, 0] = 0.3, 0.9  # at its phase it would fall; that says nothing of standing on
    risk[:, BINS] = 0.3
    judged.risk_now = risk  # pyright: ignore[reportAttributeAccessIssue]
    leans = torch.arange(16) < 4
    catch = judged.step(env.state, command, leans)
    assert catch.jumps.tolist() == leans.tolist()
    torch.testing.assert_close(catch.phase, torch.full((16,), 7 / BINS))


def test_the_clock_jumps_starts_and_hurries() -> None:
    source = CommandSource(CommandConfig(), 3, 1.0, DT)
    source.override(torch.zeros(3, 2), torch.zeros(3), torch.ones(3), torch.ones(3))
    source.reset(torch.ones(3, dtype=torch.bool), torch.Generator().manual_seed(0))
    source._stand[:], source._phase[:] = 1.0, 0.0
    yes, no = torch.tensor([True, True, False]), torch.tensor([True, False, False])
    source.step(torch.Generator(), catch=Catch(yes, torch.tensor([0.3, 0.3, 0.3]), no))
    now = source.current()
    step = DT / source.cfg.gait_period_s
    torch.testing.assert_close(now.phase, torch.tensor([0.3 + HURRY * step, 0.3 + step, 0.0]))
    assert now.stand.tolist() == [0.0, 0.0, 1.0]


def test_an_environment_with_it_uses_it_restarts_it_and_saves_it() -> None:
    cfg = H1EnvConfig(num_envs=4, num_threads=1)
    cfg.commands.step_timing, cfg.commands.step_correct_s = True, 0.1
    env = H1Env(cfg)
    assert env.step_timing is not None
    assert env.step_timing._correct_s == 0.1
    env.step_timing._since_s[:] = 0.1
    env.step(torch.zeros(4, env.num_actions))
    torch.testing.assert_close(env.step_timing._since_s, torch.full((4,), 0.1 + DT))
    saved = env.state_dict()
    env._restart(torch.tensor([True, False, False, False]))
    assert math.isinf(env.step_timing._since_s[0])
    env.load_state_dict(saved)
    torch.testing.assert_close(env.step_timing._since_s, torch.full((4,), 0.1 + DT))


def test_weights_of_another_robot_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = ROBOTS["h1"]()
    monkeypatch.setattr(step_timing, "feature_reflection", lambda _: feature_reflection(spec).part(slice(0, 6)))
    with pytest.raises(ValueError, match="fitted for another robot than 'h1'"):
        StepTiming(spec, 1, DT)


def test_shipped_weights_tell_a_robot_that_stands_from_one_that_falls(env: H1Env) -> None:
    """Random weights would say the same of both."""
    n, still = 2, torch.zeros(2, 3)
    lean, rate = torch.tensor([0.0, 0.5]), torch.tensor([0.0, 2.5])
    down = torch.stack((lean.sin(), torch.zeros(n), -lean.cos()), 1)  # leaning forward, and turning further that way
    state = dataclasses.replace(
        env.state,
        joint_pos=torch.tensor([[j.default_rad for j in env.spec.joints]]).expand(n, -1),
        joint_vel=torch.zeros(n, env.num_actions),
        projected_gravity_t=down,
        torso_angular_velocity_t=torch.stack((still[:, 0], rate, still[:, 2]), 1),
    )
    zero = torch.zeros(n)
    command = dataclasses.replace(env.commands.current(), velocity_h=still[:, :2], yaw_rate=zero, stand=zero + 1)
    risk = timing(n).risk(state, command)
    assert risk[0, BINS] < 0.1
    assert risk[1, BINS] > 0.5
    assert risk[1, :BINS].min() > risk[0, BINS]


@pytest.mark.slow
def test_it_keeps_robots_on_their_feet() -> None:
    """The same blows on walking robots under the shipped policy, with and without."""
    policy = load_policy(shipped_checkpoint("cotap"))
    falls = {}
    for timed in (True, False):
        protocol = Impact(num_envs=256, force=(500.0, 0.0, 0.0), random_direction=True, mode="walking")
        cfg = protocol.configure(policy.env_config)
        cfg.commands.step_timing, cfg.upper_body.sampling.enabled = timed, False
        env = H1Env(cfg)
        protocol.prepare(env)
        env.reset()
        fell = torch.zeros(256, dtype=torch.bool)
        for _ in range(150):
            fell |= env.step(policy(as_dict(env.get_observations())))[3]["falls"]
        falls[timed] = int(fell.sum())
    assert falls[True] < 0.7 * falls[False]
