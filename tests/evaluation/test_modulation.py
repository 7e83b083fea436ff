"""Stiffness and alpha cover their whole range, by steps and by ramps."""

from __future__ import annotations

import pytest
import torch

from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.evaluate import main
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.modulation import Modulation, sweep
from cotap.evaluation.rollout import idle, record_rollout
from cotap.evaluation.stores import StoreRecord, curve, measures, waiting


def test_sweep_by_hand():
    cycles = torch.tensor([0.0, 0.25, 0.49, 0.5, 0.75, 1.25])
    assert sweep(cycles, torch.tensor(True)).tolist() == [0.0, 0.0, 0.0, 1.0, 1.0, 0.0]
    assert sweep(cycles, torch.tensor(False)).tolist() == pytest.approx([0.0, 0.5, 0.98, 1.0, 0.5, 0.5])


def test_every_arm_goes_through_the_whole_range():
    protocol = Modulation(num_envs=4, pelvis="fixed", window=(0.0, 2.5), fall_seconds=2.5, episode_seconds=3.5)
    cfg = protocol.configure(HumanoidEnvConfig(num_threads=1))
    cfg.upper_body = LawOptions(method="cotap").configure()
    env = HumanoidEnv(cfg)
    protocol.prepare(env)
    seen = []

    def watch(env, step):
        protocol.before_step(env, step)
        p = env.upper_body.parameters
        seen.append((p.stiffness.clone(), p.alpha.clone()))

    t = record_rollout(env, idle(env), 175, progress=False, before_step=watch)
    stiffness, alpha = (torch.stack(x) for x in zip(*seen, strict=True))
    torch.testing.assert_close(stiffness.amin((0, 3)), torch.full((4, 2), 80.0), atol=6.0, rtol=0)
    torch.testing.assert_close(stiffness.amax((0, 3)), torch.full((4, 2), 1200.0), atol=70.0, rtol=0)
    assert float(alpha.amin(0).max()) < 0.05
    assert float(alpha.amax(0).min()) > 0.95
    assert sorted(stiffness[:, 0, 0, 0].unique().tolist()) == pytest.approx([80.0, 1200.0], rel=1e-4)  # steps
    assert len(stiffness[:, 1, 0, 0].unique()) > 30  # ramps
    result = protocol.measure(t, env)
    assert result["by_change"]["step"]["peak_torque"]["n"] == 2
    assert result["metrics"]["energy"]["mean"] > 0.0
    assert "recovery_s" not in result["metrics"]
    assert "reaching" not in result  # no arm has a store
    assert "stiffening_delay_s" not in result["metrics"]


def test_waiting_by_hand():
    """Asked for anew in steps 1 and 5: the first time reached after two steps, the second time never."""
    ratio = torch.tensor([1.0, 0.5, 0.9, 0.96, 0.9, 0.5, 0.6, 0.7])
    changed = torch.tensor([False, True, False, False, False, True, False, False])
    steps, reached = waiting(ratio, changed)
    assert steps.tolist() == [0.0, 2.0, 1.0, 0.0, 1.0, 3.0, 2.0, 1.0]
    assert reached.tolist() == [True, True, True, True, False, False, False, False]


def test_a_fall_ends_a_delay_unreached():
    """Half of what is asked for from step 5 on; in step 10 the env falls and begins again, where nothing is wanting."""
    record = StoreRecord()
    for t in range(20):
        ratio = torch.tensor([[0.5 if 5 <= t < 10 else 1.0]])
        asked = 100.0 if t < 5 else 200.0
        record.level.append(torch.ones(1, 1))
        record.held_back.append(torch.zeros(1, 1))
        record.ratio.append(ratio)
        record.stiffness.append(ratio * asked)
    changed = torch.zeros(20, 1, 1, dtype=torch.bool)
    changed[5] = True
    counted = torch.arange(20)[:, None] < 10
    found, more = measures(record, changed, counted, 0.02)
    assert float(found["reached_fraction"]) == 0.0
    assert float(found["stiffening_delay_s"]) == pytest.approx(5 * 0.02)
    rows = curve(record, changed | ~counted[..., None], more, 0.02, 1.0, 0)
    assert rows["ratio"] == [0.5] * 5


def test_a_stores_measures_by_hand():
    """One env of two arms, one without a store. More is asked for in step 1, less in step 4."""
    nan = float("nan")
    record = StoreRecord()
    for level, held, ratio, stiffness in ((2.0, 0.0, 1.0, 10.0), (1.0, 0.5, 0.5, 20.0), (1.2, 0.0, 0.98, 39.2),
                                          (1.4, 0.0, 1.0, 40.0), (2.0, 0.1, 1.5, 15.0)):  # fmt: skip
        for rows, value in zip((record.level, record.held_back, record.ratio), (level, held, ratio), strict=True):
            rows.append(torch.tensor([[value, nan]]))
        record.stiffness.append(torch.tensor([[stiffness, 99.0]]))
    changed = torch.zeros(5, 1, 2, dtype=torch.bool)
    changed[[1, 4]] = True
    counted = torch.ones(5, 1, dtype=torch.bool)
    found, more = measures(record, changed, counted, 0.02)
    assert more[..., 0].flatten().tolist() == [False, True, False, False, False]
    assert not more[..., 1].any()
    expected = {"store_energy": 7.6 / 5, "held_back": 0.12, "stiffening_delay_s": 0.02, "reached_fraction": 1.0}
    assert {name: float(value) for name, value in found.items()} == pytest.approx(expected)
    rows = curve(record, changed, more, 0.02, 1.0, 0)
    assert rows["time"] == pytest.approx([0.0, 0.02, 0.04])
    assert rows["asked"] == pytest.approx([40.0, 40.0, 40.0])
    assert rows["in_force"] == pytest.approx([20.0, 39.2, 40.0])
    assert rows["store_energy"] == pytest.approx([1.0, 1.2, 1.4])
    assert rows["ratio"] == pytest.approx([0.5, 0.98, 1.0])
    assert not measures(record, changed, counted & (torch.arange(5) > 1).unsqueeze(1), 0.02)[1].any()


def test_a_small_store_makes_arms_wait_and_the_plot_shows_it(tmp_path):
    protocol = Modulation(num_envs=4, pelvis="fixed", force=(0.0, 0.0, -20.0), hand="both", onset=0.5,
                          window=(0.0, 0.8), fall_seconds=0.8, episode_seconds=1.3, per_env=True)  # fmt: skip
    delays = []
    for store in (0.05, 50.0):
        cfg = protocol.configure(HumanoidEnvConfig(num_threads=1))
        cfg.upper_body = LawOptions(
            left=f"cotap:passive=true,store_energy={store},store_power=1000", right="pd"
        ).configure()
        env = HumanoidEnv(cfg)
        protocol.prepare(env)
        t = record_rollout(env, idle(env), 65, progress=False, before_step=protocol.before_step)
        result = protocol.measure(t, env)
        assert result["metrics"]["stiffening_delay_s"]["n"] == 2  # the envs with steps
        assert result["metrics"]["store_energy"]["n"] == 4
        assert result["per_env"].keys() == result["metrics"].keys() | {"stood"}
        of_envs = result["per_env"]["stiffening_delay_s"]
        assert [delay is None for delay in of_envs] == [False, True, False, True]
        delays.append(result["metrics"]["stiffening_delay_s"]["mean"])
        assert delays[-1] == pytest.approx((of_envs[0] + of_envs[2]) / 2.0, rel=1e-5)
        assert len(result["reaching"]["time"]) <= 25
    assert delays[0] > delays[1] + 0.1
    assert delays[1] == 0.0
    assert result["metrics"]["reached_fraction"]["mean"] == 1.0
    protocol.plot(tmp_path / "reaching.png", result | {"protocol": "modulation", "method": "cotap"})
    assert (tmp_path / "reaching.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("options", "message"),
    [(["--change", "leap"], "change 'leap' is unknown"), (["--method", "pd"], "needs a law with a stiffness"),
     (["--method", "soft-pd"], "got soft-pd, soft-pd"), (["--left", "pd", "--right", "soft-pd"], "got pd, soft-pd"),
     (["--stiffness-range", "0", "5"], "stiffness_range[0]"), (["--alpha-range", "0", "2"], "alpha_range[1]")],
)  # fmt: skip
def test_bad_options_are_named(options, message, capsys, shipped):  # noqa: ARG001
    assert main(["modulation", "--num-envs", "1", *options]) == 2
    assert message in capsys.readouterr().err
