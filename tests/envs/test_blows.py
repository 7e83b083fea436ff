"""Blows of training: sizes, durations, attribution, and that evaluation has none."""

import pytest
import torch

from cotap.envs import H1Env, H1EnvConfig
from cotap.envs.blows import BlowConfig, Blows
from cotap.evaluation.disturbance import ConstantLoad
from cotap.evaluation.protocols import VelocityTracking
from cotap.evaluation.static import StaticStiffness

DT = 0.02


def made(n: int = 400, **fields: object) -> tuple[Blows, torch.Generator]:
    blows = Blows(BlowConfig(enabled=True, **{"episode_share": 1.0, **fields}), n, 2, DT)  # pyright: ignore[reportArgumentType]
    rng = torch.Generator().manual_seed(0)
    blows.reset(torch.ones(n, dtype=torch.bool), rng)
    return blows, rng


def test_blows_have_the_size_time_and_place_that_was_asked_for() -> None:
    n = 400
    blows, rng = made(n, force=(200.0, 400.0), duration_s=(0.04, 0.04), interval_s=(3.0, 4.0), curriculum_start=0.5)
    nobody = torch.zeros(n, dtype=torch.bool)
    forces = []
    for _ in range(900):
        forces.append(blows.current())
        blows.step(nobody, False, rng)
    force = torch.stack(forces)  # (T, N, 2, 3)
    size = force.norm(dim=-1)
    struck = size > 0.0
    assert not struck.all(2).any(), "one hand at a time"
    assert size[struck].min() >= 100.0
    assert size[struck].max() <= 200.0
    assert (force[struck][:, 2].abs() <= size[struck] * torch.tensor(0.5).sin() + 1e-3).all()
    on = struck.any(2)
    starts = on & ~torch.cat((torch.zeros_like(on[:1]), on[:-1]))
    assert on.sum() == 2 * starts.sum() - starts[-1].sum(), "0.04 s are two steps"
    # 18 s with a blow every 3.5 s on average, the first after an interval like the others.
    assert starts.sum(0).float().mean().item() == pytest.approx(18.0 / 3.5 - 0.5, rel=0.05)
    for world in range(0, n, 40):
        gaps = starts[:, world].nonzero().diff(dim=0) * DT
        assert gaps.min() >= 3.0 - 1e-4
        assert gaps.max() <= 4.0 + DT + 1e-4
    left_share = struck.float().sum((0, 1))
    assert left_share[0] / left_share.sum() == pytest.approx(0.5, abs=0.03)
    direction = force[struck][:, :2]
    assert direction.mean(0).norm() < 15.0, "no preferred direction"


def test_size_grows_for_blows_taken_and_falls_for_those_that_throw() -> None:
    blows, rng = made(3, interval_s=(2.5, 2.5), recovery_s=2.0, curriculum_start=0.5)
    fell = torch.zeros(3, dtype=torch.bool)
    while not blows.current().any():
        blows.step(fell, True, rng)
    assert blows.recovering().all()
    blows.step(torch.tensor([False, True, False]), True, rng)
    torch.testing.assert_close(blows.scale, torch.tensor([0.5, 0.1, 0.5]))
    blows.reset(torch.tensor([False, True, False]), rng)
    assert blows.recovering().tolist() == [True, False, True]
    for _ in range(101):
        blows.step(fell, True, rng)
    torch.testing.assert_close(blows.scale, torch.tensor([0.52, 0.1, 0.52]))
    # A fall with nothing to recover from says nothing about blows.
    blows.step(torch.tensor([True, True, True]), True, rng)
    torch.testing.assert_close(blows.scale, torch.tensor([0.52, 0.1, 0.52]))


def test_some_episodes_are_spared() -> None:
    blows, rng = made(2000, episode_share=0.25)
    nobody = torch.zeros(2000, dtype=torch.bool)
    struck = torch.zeros(2000, dtype=torch.bool)
    for _ in range(450):
        struck |= blows.current().any(2).any(1)
        blows.step(nobody, True, rng)
    assert struck.float().mean().item() == pytest.approx(0.25, abs=0.04)
    assert (blows.scale[~struck] == blows.cfg.curriculum_start).all(), "what is spared proves nothing"


def test_sizes_stay_while_the_gantry_holds_the_robot() -> None:
    blows, rng = made(8)
    for _ in range(600):
        blows.step(torch.ones(8, dtype=torch.bool), False, rng)
    assert (blows.scale == blows.cfg.curriculum_start).all()


def test_blows_reach_the_robot_and_come_back_from_a_snapshot() -> None:
    cfg = H1EnvConfig(num_envs=4, num_threads=1)
    cfg.hand_forces.enabled = False
    cfg.blows = BlowConfig(enabled=True, episode_share=1.0, interval_s=(0.1, 0.1), recovery_s=0.1, curriculum_start=1.0)
    env = H1Env(cfg)
    still = torch.zeros(4, env.num_actions)
    largest, state, after = 0.0, None, []
    for step in range(24):
        env.step(still)
        if step == 11:
            state = env.state_dict()
        if step > 11:
            after.append(env.get_observations()["privileged"].clone())
        largest = max(largest, float(env._hand_force_w.norm(dim=2).max()))
    assert 100.0 <= largest <= 500.0
    assert state is not None
    other = H1Env(cfg)
    other.load_state_dict(state)
    for expected in after:
        other.step(still)
        assert torch.equal(other.get_observations()["privileged"], expected)


@pytest.mark.parametrize("protocol", [VelocityTracking(), ConstantLoad(), StaticStiffness()])
def test_no_protocol_has_blows_of_training(protocol: VelocityTracking | ConstantLoad | StaticStiffness) -> None:
    cfg = H1EnvConfig()
    cfg.blows.enabled = True
    assert not protocol.configure(cfg).blows.enabled


@pytest.mark.parametrize(
    ("fields", "name"),
    [
        ({"force": (-1.0, 5.0)}, r"blows\.force"),
        ({"duration_s": (0.1, 0.02)}, r"blows\.duration_s"),
        ({"interval_s": (1.0, 2.0)}, r"blows\.interval_s"),
        ({"recovery_s": -1.0}, r"blows\.recovery_s"),
        ({"curriculum_step": float("nan")}, r"blows\.curriculum_step"),
    ],
)
def test_bad_values_are_named(fields: dict[str, object], name: str) -> None:
    with pytest.raises(ValueError, match=name):
        BlowConfig(**fields).check()  # pyright: ignore[reportArgumentType]
