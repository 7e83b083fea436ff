"""Impact and constant load: measures on hand-made trajectories, and what a blow does in simulation."""

from __future__ import annotations

import json
import math

import pytest
import torch
from test_metrics import trajectory

from cotap.envs import H1Env, H1EnvConfig
from cotap.evaluate import main
from cotap.evaluation.disturbance import ConstantLoad, Impact, curve, disturbance_measures, recovery_time
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.rollout import record_rollout

SIDES = ("left", "right")


def test_measures_by_hand():
    """Onset at 1 s, window of 1 s: what lies outside does not count."""
    t = trajectory(steps=150, worlds=2)
    inside = slice(50, 100)
    t.velocity[inside, 0, :2] += torch.tensor([0.3, -0.4])
    t.velocity[:50] += 9.0
    t.velocity[100:] += 9.0
    t.hand_error[inside, 0, 0], t.hand_error[inside, 0, 1] = 0.2, 0.1
    t.arm_torque[inside, 0, 0], t.arm_torque[inside, 0, 1] = 3.0, -4.0
    t.arm_velocity[inside, 0, :2] = 0.5
    t.arm_error[inside, 0, 2] = 0.25
    t.arm_at_limit[60:70, 0] = True
    m = disturbance_measures(t, Impact(onset=1.0), SIDES)
    expected = {"e_torso": 0.5, "e_ee": 0.15, "e_ee_hit": 0.2, "j_upper": 5.0, "e_upper": 0.25, "peak_torque": 4.0,
                "share_at_limit": 0.2, "energy": 3.5, "fall_fraction": 0.0}  # fmt: skip
    for name, value in expected.items():
        assert float(m[name][0]) == pytest.approx(value, abs=1e-5), name
        assert float(m[name][1]) == pytest.approx(0.0, abs=1e-5), name
    right = disturbance_measures(t, Impact(onset=1.0, hand="right"), SIDES)
    assert float(right["e_ee_hit"][0]) == pytest.approx(0.1)
    both = disturbance_measures(t, Impact(onset=1.0, hand="both"), SIDES)
    assert float(both["e_ee_hit"][0]) == pytest.approx(0.15)


def test_a_world_that_falls_is_measured_up_to_its_fall():
    t = trajectory(steps=100, worlds=2)
    t.hand_error[50:75, 0] = 0.1
    t.hand_error[75:, 0] = 9.0
    t.fell[75, 0] = True
    t.fell[20, 1] = True
    m = disturbance_measures(t, Impact(onset=1.0), SIDES)
    assert float(m["e_ee"][0]) == pytest.approx(0.1)
    assert m["e_ee"][1].isnan()
    assert m["fall_fraction"].tolist() == [1.0, 1.0]


def test_recovery_by_hand():
    """Error 0.02 before; 0.3 for 0.4 s, 0.025 after: back under 0.03 after 0.4 s."""
    error = torch.full((150, 3), 0.02)
    error[50:70, 0] = 0.3
    error[70:, 0] = 0.025
    error[50:, 1] = 0.3  # never comes back
    alive = torch.ones(150, 3, dtype=torch.bool)
    times = recovery_time(error, alive, 50, 0.02)
    assert float(times[0]) == pytest.approx(0.4)
    assert times[1].isnan()
    assert times[2].isnan()  # never left
    alive[60:, 0] = False
    assert recovery_time(error, alive, 50, 0.02)[0].isnan()


def test_curves_are_means_over_worlds_that_stood():
    t = trajectory(steps=100, worlds=2)
    t.hand_error[:, 0] = 0.1
    t.hand_error[:, 1] = 9.0
    t.fell[10, 1] = True
    t.hand_position[60:, 0, 0, 2] = -0.05
    c = curve(t, Impact(onset=1.0), SIDES)
    assert c["time"][0] == pytest.approx(-1.0)
    assert len(c["time"]) == 100
    assert c["hand_error"] == pytest.approx([0.1] * 100)
    assert c["hand_displacement_z"][-1] == pytest.approx(-0.05)
    assert c["hand_displacement_z"][40] == 0.0


def run(protocol, **laws):
    cfg = protocol.configure(H1EnvConfig(num_threads=1))
    cfg.fixed_base = True  # arms alone: no policy is needed
    cfg.upper_body = LawOptions(**laws).configure()
    env = H1Env(cfg)
    protocol.command(env)
    nothing = lambda obs: torch.zeros(obs["policy"].shape[0], 19)  # noqa: E731
    t = record_rollout(env, nothing, round(protocol.seconds / env.dt), progress=False)
    return t, disturbance_measures(t, protocol, SIDES)


def test_a_softer_hand_gives_way_further_and_pulls_less():
    """Constant load of 10 N on a fixed torso: displacement is monotone in stiffness, as statics has it."""
    load = ConstantLoad(num_envs=2, force=(0.0, 0.0, -10.0), onset=2.0, randomize=False)
    errors = [
        float(run(load, method="cotap", stiffness=(k,), error="task")[1]["e_ee_hit"].mean()) for k in (400.0, 800.0)
    ]
    assert errors == pytest.approx([10.0 / 400.0, 10.0 / 800.0], rel=0.05)


def test_a_blow_moves_the_hand_that_it_hits():
    blow = Impact(num_envs=2, force=(200.0, 0.0, 0.0), onset=1.0, window=(0.0, 5.0), randomize=False)
    t, m = run(blow, method="cotap", stiffness=(800.0,))
    assert float(t.hand_error[:49, :, 0].max()) < 0.02
    assert float(t.hand_error[50:, :, 0].max()) > 0.1
    assert float(t.hand_error[50:, :, 1].max()) < 0.05
    assert (m["recovery_s"] > 0.1).all()
    assert (m["e_ee_hit"] > m["e_ee"]).all()


@pytest.mark.parametrize("protocol", ["impact", "constant-load"])
def test_the_command_writes_what_was_asked_for(protocol, tmp_path, capsys):
    out = tmp_path / "out.json"
    arguments = [protocol, "--num-envs", "16", "--method", "cotap", "--stiffness", "500", "--threads", "1",
                 "--json", str(out), "--plot", str(tmp_path / "plot.png")]  # fmt: skip
    assert main(arguments) == 0
    result = json.loads(out.read_text())
    assert result["protocol"] == protocol
    assert result["settings"]["stiffness"] == [500.0]
    assert {"e_torso", "e_ee", "e_ee_hit", "j_upper", "e_upper", "recovery_s"} <= result["metrics"].keys()
    assert result["window"] == ({"start": 3.0, "end": 4.0} if protocol == "impact" else {"start": 5.0, "end": 7.0})
    assert (tmp_path / "plot.png").stat().st_size > 5000
    assert "| e_ee_hit |" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--mode", "flying"], "mode 'flying' is unknown"),
        (["--hand", "foot"], "force.hand 'foot' is unknown"),
        (["--num-envs", "0"], "num_envs"),
        (["--window", "1", "0.5"], "window[1]"),
        (["--force", "nan", "0", "0"], "force.force[0]"),
        (["--motion", "moonwalk"], "no clip is called 'moonwalk'"),
    ],
)
def test_bad_options_are_named(options, message, capsys):
    assert main(["impact", *options]) == 2
    assert message in capsys.readouterr().err
    assert math.isfinite(Impact().seconds)
