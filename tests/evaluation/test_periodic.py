"""Periodic load: amplitudes by hand, and a slow load on real arms asks for what statics says."""

from __future__ import annotations

import math

import pytest
import torch
from test_metrics import DT, trajectory

from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.evaluate import main
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.periodic import PeriodicLoad, amplitude, elbow_joints, swing_measures
from cotap.evaluation.rollout import idle, record_rollout


def test_amplitude_is_that_of_its_frequency_alone():
    angle = 2.0 * math.pi * DT / 4.0 * torch.arange(400)
    drifting = 5.0 + 0.4 * angle + 3.0 * (angle + 0.7).sin()
    assert float(amplitude(drifting.unsqueeze(1), 4.0, DT)) == pytest.approx(3.0, rel=1e-4)
    harmonic = drifting + 2.0 * (3.0 * angle).cos()
    assert float(amplitude(harmonic.unsqueeze(1), 4.0, DT)) == pytest.approx(3.0, rel=1e-2)


def test_swing_measures_by_hand(spec):
    elbows = elbow_joints(spec)
    assert [spec.upper_joints[i] for i in elbows] == ["left_elbow", "right_elbow"]
    t = trajectory(steps=450, envs=2)
    wave = (2.0 * math.pi * DT / 4.0 * torch.arange(450)).sin()
    t.arm_torque[:, :, elbows[0]] = 2.0 + 3.0 * wave.unsqueeze(1)
    t.arm_torque[:, :, elbows[1]] = 6.0 * wave.unsqueeze(1)
    t.arm_static_torque[:, :, elbows[0]] = t.arm_static_torque[:, :, elbows[1]] = 5.0 * wave.unsqueeze(1)
    t.arm_velocity[:, :, elbows[0]] = 0.1
    t.hand_offset[:, :, 1, 2] = 0.04 * wave.unsqueeze(1)
    t.fell[300, 1] = True
    m = swing_measures(t, 50, 450, 4.0, elbows, ["left", "right"])
    expected = {"elbow_amplitude_left": 3.0, "elbow_amplitude_right": 6.0, "elbow_amplitude_static_left": 5.0,
                "elbow_peak_left": 5.0, "elbow_rms_right": 6.0 / math.sqrt(2.0), "hand_swing_right": 0.04,
                "hand_swing_left": 0.0, "elbow_amplitude_ratio": 0.5, "elbow_amplitude_static_ratio": 1.0}  # fmt: skip
    for name, value in expected.items():
        assert float(m[name][0]) == pytest.approx(value, abs=1e-3), name
        assert m[name][1].isnan(), name
    assert float(m["energy_left"][0]) == pytest.approx(0.1 * DT * float(t.arm_torque[50:450, 0, elbows[0]].abs().sum()))


@pytest.mark.slow
def test_a_slow_load_asks_for_the_same_torque_whatever_the_stiffness():
    """Fixed pelvis, compliant left arm, PD on the right: torques are those of statics, the left hand swings more."""
    given = {"pelvis": "fixed", "randomize": False, "force": (0.0, 0.0, 10.0), "periods": 2, "per_env": True}
    protocol = PeriodicLoad(num_envs=1, **given)
    cfg = protocol.configure(HumanoidEnvConfig(num_threads=1))
    cfg.upper_body = LawOptions(left="cotap:alpha=1,stiffness=400", right="pd").configure()
    env = HumanoidEnv(cfg)
    protocol.prepare(env)
    t = record_rollout(env, idle(env), round(protocol.seconds / env.dt), progress=False)
    measured = protocol.measure(t, env)
    m = {k: v["mean"] for k, v in measured["metrics"].items()}
    assert measured["per_env"]["hand_swing_left"] == [pytest.approx(m["hand_swing_left"], rel=1e-4)]
    for side in ("left", "right"):
        assert m[f"elbow_amplitude_{side}"] == pytest.approx(m[f"elbow_amplitude_static_{side}"], rel=0.02)
    assert m["elbow_amplitude_ratio"] == pytest.approx(1.0, abs=0.05)
    assert m["hand_swing_left"] > 1.3 * m["hand_swing_right"]


def test_bad_options_are_named(capsys):
    assert main(["periodic-load", "--periods", "1"]) == 2
    assert "periods" in capsys.readouterr().err
