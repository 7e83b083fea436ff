"""Impact and constant load: measures on hand-made trajectories, and what a push does in simulation."""

from __future__ import annotations

import json
import math

import pytest
import torch
from test_metrics import trajectory

from cotap.compare import compare
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.actions import ActionConfig
from cotap.envs.arm_task import task_forces
from cotap.envs.commands import CommandConfig
from cotap.evaluate import main
from cotap.evaluation.disturbance import (
    ConstantLoad,
    Impact,
    curve,
    falls_by_time,
    impedance_error,
    load_overshoot,
    recovery,
    response_measures,
    window_measures,
)
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.protocol import mirrored_pose
from cotap.evaluation.rollout import acting, idle, record_rollout
from cotap.evaluation.velocity_tracking import VelocityTracking
from cotap.motions.reference import ClipConfig, ReferenceConfig

LEFT, RIGHT, BOTH = [0], [1], [0, 1]


def test_measures_by_hand():
    """Onset at 1 s, window of 1 s: what lies outside does not count."""
    t = trajectory(steps=150, envs=2)
    inside = slice(50, 100)
    t.velocity[inside, 0, :2] += torch.tensor([0.3, -0.4])
    t.velocity[:50] += 9.0
    t.velocity[100:] += 9.0
    t.hand_error[inside, 0, 0], t.hand_error[inside, 0, 1] = 0.2, 0.1
    t.arm_torque[inside, 0, 0], t.arm_torque[inside, 0, 1] = 3.0, -4.0
    t.arm_velocity[inside, 0, :2] = 0.5
    t.arm_error[inside, 0, 2] = 0.25
    t.torque_share[60:80, 0, :2] = 0.95  # of a leg
    t.torque_share[50:55, 0, 3] = 1.0  # of a leg, which is no arm at its limit
    t.torque_share[60:70, 0, 11 + 5] = 1.0  # of an arm
    m = window_measures(t, 50, 100, LEFT)
    expected = {"e_torso": 0.5, "e_ee": 0.15, "e_ee_hit": 0.2, "j_upper": 5.0, "e_upper": 0.25, "peak_torque": 4.0,
                "share_at_limit": 0.2, "joints_near_limit": (20 * 2 + 5 + 10) / (50 * 19), "energy": 3.5,
                "fall_fraction": 0.0}  # fmt: skip
    for name, value in expected.items():
        assert float(m[name][0]) == pytest.approx(value, abs=1e-5), name
        assert float(m[name][1]) == pytest.approx(0.0, abs=1e-5), name
    right = window_measures(t, 50, 100, RIGHT)
    assert float(right["e_ee_hit"][0]) == pytest.approx(0.1)
    both = window_measures(t, 50, 100, BOTH)
    assert float(both["e_ee_hit"][0]) == pytest.approx(0.15)


def test_a_world_that_falls_is_measured_up_to_its_fall():
    t = trajectory(steps=100, envs=2)
    t.hand_error[50:75, 0] = 0.1
    t.hand_error[75:, 0] = 9.0
    t.fell[75, 0] = True
    t.fell[20, 1] = True
    m = window_measures(t, 50, 100, LEFT)
    assert float(m["e_ee"][0]) == pytest.approx(0.1)
    assert m["e_ee"][1].isnan()
    assert m["fall_fraction"].tolist() == [1.0, 1.0]


def test_the_whole_episode_counts_what_the_window_leaves_out():
    t = trajectory(steps=100, envs=1)
    t.arm_torque[:50, 0, 0] = 10.0
    assert float(window_measures(t, 50, 100, LEFT)["j_upper"]) == 0.0
    assert float(window_measures(t, 0, 100, LEFT)["j_upper"]) == pytest.approx(5.0)


def test_recovery_by_hand():
    """Error 0.02 before; 0.3 for 0.4 s, 0.029 after: back within a centimetre of it after 0.4 s."""
    error = torch.full((150, 3), 0.02)
    error[50:70, 0] = 0.3
    error[70:, 0] = 0.029
    error[50:, 1] = 0.3  # never comes back
    alive = torch.ones(150, 3, dtype=torch.bool)
    times, back = recovery(error, alive, 50, 0.02)
    assert float(times[0]) == pytest.approx(0.4)
    assert times[1].isnan()
    assert times[2].isnan()  # never left
    assert back.tolist() == [True, False, True]
    alive[60:, 0] = False
    times, back = recovery(error, alive, 50, 0.02)
    assert times[0].isnan()
    assert not back[0]


def test_displacement_is_what_the_load_adds():
    """5 cm down under the load, 1 cm off before it, in the hand that is loaded."""
    t = trajectory(steps=150, envs=2)
    t.hand_offset[:, :, 0, 2] = -0.01
    t.hand_offset[50:, :, 0, 2] = -0.06
    t.hand_offset[50:, :, 1, 2] = 9.0
    t.fell[80, 1] = True
    m = response_measures(t, 50, 75, 150, LEFT)
    assert float(m["displacement_z"][0]) == pytest.approx(-0.05)
    assert float(m["displacement_x"][0]) == 0.0
    assert m["displacement_z"][1].isnan()


def test_impedance_error_is_the_distance_from_a_springs_displacement():
    """-15 N at 300 N/m is 5 cm down; the hand is 2 cm short of it and 1.5 cm to the side."""
    moved = {"displacement_x": torch.tensor([0.0, math.nan]), "displacement_y": torch.tensor([0.015, 0.0]),
             "displacement_z": torch.tensor([-0.03, 0.0])}  # fmt: skip
    error = impedance_error(moved, (0.0, 0.0, -15.0), (100.0, 200.0, 300.0))
    assert float(error[0]) == pytest.approx(0.025)
    assert error[1].isnan()


def test_a_load_overshoots_by_what_it_carries_the_hand_beyond_its_rest():
    """From 0.01 m to rest 0.1 m lower, at first 0.13 m: by 0.3; to the side, and after a fall, nothing counts."""
    t = trajectory(steps=200, envs=3)
    t.hand_offset[:, :, 0, 2] = 0.01
    t.hand_offset[50:, :2, 0, 2] = -0.09
    t.hand_offset[60:65, :, 0, 2] = -0.12
    t.hand_offset[60:65, :, 0, 0] = 0.5
    t.hand_offset[120:125, 0, 0, 2] = -0.2  # sway, long after the hand first turned back
    t.fell[100, 1] = True
    over = load_overshoot(t, 50, 150, 200, LEFT)
    assert float(over[0]) == pytest.approx(0.3, abs=1e-5)
    assert over[1:].isnan().all()  # the last one's hand rests where it was


def test_a_hand_that_creeps_to_its_rest_does_not_overshoot_it():
    """What sways beyond the rest later does not count."""
    t = trajectory(steps=200, envs=1)
    t.hand_offset[50:, 0, 0, 2] = -0.1 * (1.0 - torch.exp(-torch.arange(150) / 20.0))
    t.hand_offset[120:, 0, 0, 2] += 0.01 * torch.sin(torch.arange(80) / 5.0)  # first back, then beyond
    assert float(load_overshoot(t, 50, 150, 200, LEFT)) < 0.05


def test_energy_is_counted_from_the_end_of_the_push():
    """50 ms are two and a half control steps: the third still pushes."""
    protocol = Impact(num_envs=1, episode_seconds=5.0)
    env = HumanoidEnv(protocol.configure(HumanoidEnvConfig(num_threads=1)))
    t = trajectory(steps=250, envs=1)
    onset = round(protocol.onset / t.dt)
    t.hand_offset[onset + 2 :, 0, 0, 0] = 0.1  # at 5 m/s in the third step, at rest after
    assert protocol.measure(t, env)["metrics"]["transient_energy"]["mean"] == 0.0
    t.hand_offset[onset + 3 :, 0, 0, 0] = 0.2
    assert protocol.measure(t, env)["metrics"]["transient_energy"]["mean"] > 0.0


def test_a_window_ends_with_the_record():
    protocol = Impact(onset=1.03, window=(0.0, 1.03), fall_seconds=1.0, episode_seconds=2.06)
    protocol.check()
    assert protocol.measured_steps(0.02).stop == 103


def test_falls_count_to_the_end_of_their_window():
    """Onset at 1 s, measures for 1 s, falls for 3 s after it, record of 5 s."""
    protocol = Impact(num_envs=3, episode_seconds=5.0)
    t = trajectory(steps=250, envs=3)
    t.fell[190, 0] = t.fell[220, 1] = True
    env = HumanoidEnv(protocol.configure(HumanoidEnvConfig(num_threads=1)))
    result = protocol.measure(t, env)
    assert result["falls"] == {"before_onset": 0, "to_window_end": 1, "later": 1}
    assert result["metrics"]["fall_fraction"]["mean"] == pytest.approx(1.0 / 3.0)


@pytest.mark.parametrize("mode", ["residual", "absolute"])
def test_the_raw_reference_takes_the_upper_agents_place(make_env, robot, mode):
    """A policy that would throw the arms about is not asked; arms are sent where the reference is."""
    env = make_env(2, robot=robot, actions=ActionConfig(upper_mode=mode))
    env.motions.hold(env.motions.default + 0.1)
    wild = acting(env, lambda _: torch.full((2, env.num_actions), 5.0), "reference")
    action = wild({})
    assert (action[:, env.action_slices["lower"]] == 5.0).all()
    env.step(action)
    upper = env.action_slices["upper"]
    torch.testing.assert_close(env.actuation.current[:, upper], env.motions.current().position)
    assert (acting(env, lambda _: torch.full((2, env.num_actions), 5.0), "policy")({})[:, upper] == 5.0).all()


@pytest.mark.parametrize("mode", ["residual", "absolute"])
def test_a_share_of_the_upper_agents_actions_goes_that_share_of_the_way(make_env, robot, mode):
    """Joint targets lie between the raw reference's and the policy's own; so do those of the legs' own actions."""
    targets = []
    for upper_actions in ("reference", "0", "0.25", "1.0", "policy"):
        env = make_env(2, robot=robot, actions=ActionConfig(upper_mode=mode))
        env.motions.hold(env.motions.default + 0.1)
        env.step(acting(env, lambda _, env=env: torch.full((2, env.num_actions), 0.5), upper_actions)({}))
        targets.append(env.actuation.current)
    raw, none, quarter, whole, own = targets
    assert torch.equal(raw, none)
    assert torch.equal(whole, own)
    torch.testing.assert_close(quarter, raw + 0.25 * (own - raw))
    assert ((own - raw)[:, env.action_slices["upper"]].abs() > 0.01).all()


def test_arms_hold_a_pose_of_as_many_joints_as_they_have(make_env, robot):
    env = make_env(1, robot=robot)
    joints = len(env.spec.arms[0].joints)
    assert torch.equal(mirrored_pose(env, ()), env.motions.default)
    left = tuple(0.01 * (i + 1) for i in range(joints))
    assert mirrored_pose(env, left)[env.spec.upper_joints.index(env.spec.arms[0].joints[1])] == pytest.approx(0.02)
    with pytest.raises(ValueError, match=f"arm_pose must have {joints} numbers"):
        mirrored_pose(env, left[1:])


def test_falls_are_counted_by_when():
    t = trajectory(steps=150, envs=5)
    for env, step in enumerate((10, 50, 99, 100)):
        t.fell[step, env] = True
    t.fell[120, 0] = True  # once is enough
    assert falls_by_time(t, 50, 100) == {"before_onset": 1, "to_window_end": 2, "later": 1}


def test_curves_are_means_over_envs_that_stood():
    t = trajectory(steps=100, envs=2)
    t.hand_error[:, 0] = 0.1
    t.hand_error[:, 1] = 9.0
    t.fell[10, 1] = True
    t.hand_offset[60:, 0, 0, 2] = -0.05
    t.velocity[:, 0, 1] += 0.2
    c = curve(t, 50, LEFT)
    assert c["time"][0] == pytest.approx(-0.98)  # what is recorded is the end of a step
    assert len(c["time"]) == 100
    assert c["hand_error"] == pytest.approx([0.1] * 100)
    assert c["hand_displacement_z"][-1] == pytest.approx(-0.05)
    assert c["hand_displacement_z"][40] == 0.0
    assert c["velocity_error_y"] == pytest.approx([0.2] * 100)


def run(protocol, robot="h1", **laws):
    cfg = protocol.configure(HumanoidEnvConfig(robot, num_threads=1))
    cfg.upper_body = LawOptions(**laws).configure()
    env = HumanoidEnv(cfg)
    protocol.prepare(env)
    t = record_rollout(env, idle(env), round(protocol.seconds / env.dt), progress=False)
    return t, protocol.measure(t, env)


def test_a_held_load_measures_the_stiffness_that_was_asked_for():
    """Constant load of 10 N on a fixed torso: displacement and stiffness as statics has them."""
    load = ConstantLoad(num_envs=2, force=(0.0, 0.0, -10.0), randomize=False, pelvis="fixed")
    _, result = run(load, method="cotap", stiffness=(400.0,), error="task")
    assert result["metrics"]["displacement_z"]["mean"] == pytest.approx(-10.0 / 400.0, rel=0.05)
    stiffness = result["effective_stiffness"]
    assert stiffness["commanded"] == [400.0] * 3
    assert stiffness["measured"][2] == pytest.approx(400.0, rel=0.05)
    assert stiffness["measured"][:2] == [None, None]
    assert stiffness["reason"]


def test_statics_asks_for_the_torque_that_holds_the_load():
    load = ConstantLoad(num_envs=2, force=(0.0, 3.0, -10.0), randomize=False, pelvis="fixed", hand="both")
    t, _ = run(load, left="cotap:stiffness=400", right="pd")
    torch.testing.assert_close(t.arm_static_torque[-1], t.arm_torque[-1], atol=0.05, rtol=0)
    assert float(t.arm_static_torque[-1].abs().max()) > 2.0


def test_a_push_moves_the_hand_that_it_hits():
    push = Impact(num_envs=2, force=(200.0, 0.0, 0.0), randomize=False, pelvis="fixed", motion=("none",))
    t, m = run(push, method="cotap", stiffness=(800.0,))
    assert float(t.hand_error[:49, :, 0].max()) < 0.02
    assert float(t.hand_error[50:, :, 0].max()) > 0.04
    assert float(t.hand_error[50:, :, 1].max()) < 0.05
    assert m["metrics"]["recovery_s"]["mean"] > 0.1
    assert m["metrics"]["e_ee_hit"]["mean"] > m["metrics"]["e_ee"]["mean"]
    assert m["effective_stiffness"]["measured"] is None
    assert "over before" in m["effective_stiffness"]["reason"]


def test_what_a_robot_that_falls_draws_is_nothing_to_the_others(make_env):
    """Two rollouts of one seed, one robot of the second begins again: all else that is drawn is the same, its own too.
    The next rollout draws anew."""

    def rollout(falls: bool, times: int = 1) -> list[torch.Tensor]:
        motions = ReferenceConfig(clips=ClipConfig(hold_s=(0.1, 0.4)))
        env = make_env(12, commands=CommandConfig(resample_s=(0.1, 0.5)), motions=motions, forces=task_forces())

        def fall(env: HumanoidEnv, step: int) -> None:
            if falls and step in (4, 11):
                env._restart(torch.arange(12) == 0)

        for _ in range(times):
            record_rollout(env, idle(env), 60, progress=False, before_step=fall)
        assert env.redraws
        load = env.forces.hand_loads.state_dict()["_force_h"]
        return [env.commands.asked_velocity, env.motions.current().position, env.actuation.delay_s, load]

    straight, fell, again = rollout(False), rollout(True), rollout(False, 2)
    for a, b, c in zip(straight, fell, again, strict=True):
        assert torch.equal(a, b)
        assert not torch.equal(a, c)


def test_a_load_on_hands_of_two_stiffnesses_has_none_that_was_asked_for():
    load = ConstantLoad(num_envs=2, force=(0.0, 0.0, -10.0), randomize=False, pelvis="fixed", hand="both")
    for right, asked in (("100", [100.0] * 3), ("800", None)):
        _, result = run(load, left="cotap:stiffness=100", right=f"cotap:stiffness={right}")
        assert result["effective_stiffness"]["commanded"] == asked
        assert ("impedance_error" in result["metrics"]) == (asked is not None)


def test_a_push_on_the_base_is_on_no_hand(robot):
    velocity = []
    for force in (0.0, 200.0):
        push = Impact(num_envs=2, force=(force, 0.0, 0.0), place="base", onset=0.5, duration=0.1, motion=("none",))
        env = HumanoidEnv(push.configure(HumanoidEnvConfig(robot, num_threads=1)))
        push.prepare(env)
        velocity.append(record_rollout(env, idle(env), 31, progress=False).velocity[:, :, 0])
        assert not env.hand_force_w.any()
    assert torch.equal(velocity[0][:25], velocity[1][:25])
    assert (velocity[1][-1] - velocity[0][-1] > 0.1).all()  # 20 N s on 50 kg and less


@pytest.mark.slow
def test_the_same_seed_gives_the_same_json_and_more_threads_the_same_figures(checkpoint, tmp_path):
    """Bit for bit with one number of threads; another may add in another order, and agrees within the intervals."""
    results = []
    for i, threads in enumerate((1, 1, 2)):
        out = tmp_path / f"{i}.json"
        arguments = ["--checkpoint", str(checkpoint), "--num-envs", "32", "--seed", "3", "--json", str(out)]
        assert main(["impact", *arguments, "--threads", str(threads)]) == 0
        results.append(json.loads(out.read_text()))
        results[-1].pop("seconds")
    assert results[0] == results[1]
    assert results[0]["metrics"]["e_torso"]["std"] > 0.0  # envs differ, so intervals say something
    for name in ("e_torso", "e_ee", "e_ee_hit", "j_upper", "e_upper"):
        one, two = (r["metrics"][name]["ci95"] for r in results[1:])
        assert one[0] <= two[1], name
        assert two[0] <= one[1], name


@pytest.mark.slow
@pytest.mark.parametrize("protocol", ["impact", "constant-load"])
def test_the_command_writes_what_was_asked_for(protocol, checkpoint, tmp_path, capsys):
    out = tmp_path / "out.json"
    arguments = ["--num-envs", "16", "--method", "cotap", "--stiffness", "500", "--threads", "1",
                 "--json", str(out), "--plot", str(tmp_path / "plot.png")]  # fmt: skip
    assert main([protocol, "--checkpoint", str(checkpoint), *arguments]) == 0
    result = json.loads(out.read_text())
    assert result["protocol"] == protocol
    assert result["settings"]["stiffness"] == [500.0]
    assert {"e_torso", "e_ee", "e_ee_hit", "j_upper", "e_upper", "recovery_s"} <= result["metrics"].keys()
    assert result["window"] == ({"start": 1.0, "end": 2.0} if protocol == "impact" else {"start": 3.0, "end": 5.0})
    assert result["metrics_without_falls"].keys() == result["metrics"].keys()
    assert sum(result["falls"].values()) == result["num_falls"]
    assert result["arms"] == ("moving" if protocol == "impact" else "held")
    assert (tmp_path / "plot.png").stat().st_size > 5000
    assert result["metrics"]["j_upper_push"]["n"] == 16
    for of_loads in ("load_overshoot", "impedance_error"):
        assert (of_loads in result["metrics"]) == (protocol == "constant-load")
    assert "per_env" not in result
    assert "| e_ee_hit |" in capsys.readouterr().out


@pytest.mark.parametrize(("method", "measured"), [("pd", False), ("cotap", True)])
def test_a_held_hand_gives_way_as_the_stiffness_says(method, measured, tmp_path):
    """10 N at 500 N/m is 2 cm; the task error makes that exact, and PD commands no stiffness."""
    law = ["--stiffness", "500", "--error", "task"] if measured else []
    out = tmp_path / "out.json"
    arguments = ["--method", method, *law, "--pelvis", "fixed", "--force", "0", "0", "-10", "--num-envs", "2",
                 "--no-randomize", "--threads", "1", "--json", str(out)]  # fmt: skip
    assert main(["constant-load", *arguments]) == 0
    metrics = json.loads(out.read_text())["metrics"]
    assert ("impedance_error" in metrics) == measured
    if measured:
        assert metrics["impedance_error"]["mean"] < 5e-4
        assert metrics["displacement_z"]["mean"] == pytest.approx(-0.02, abs=5e-4)


def test_the_push_itself_is_the_first_tenth_of_a_second():
    protocol = Impact(num_envs=1)
    t = trajectory(steps=150, envs=1)
    t.arm_torque[50:55, 0, 0] = 30.0
    env = HumanoidEnv(protocol.configure(HumanoidEnvConfig(num_threads=1)))
    m = protocol.measure(t, env)["metrics"]
    assert m["j_upper_push"]["mean"] == pytest.approx(30.0)
    assert m["j_upper"]["mean"] == pytest.approx(3.0)


@pytest.mark.parametrize("per_env", [True, False])
def test_two_evaluations_of_velocity_tracking_compare_env_by_env(per_env):
    """Arms 0.1 and 0.9 rad off before, half of that after: the mean of the pairs' differences, -0.25, is in doubt by
    their spread alone."""
    protocol, results = VelocityTracking(num_envs=2, episode_seconds=6.0, per_env=per_env), []
    env = HumanoidEnv(protocol.configure(HumanoidEnvConfig(num_threads=1)))
    for factor in (1.0, 0.5):
        t = trajectory(steps=300, envs=2)
        t.arm_error[:, :, 0] = factor * torch.tensor([0.1, 0.9])
        results.append(protocol.measure(t, env) | {"protocol": "velocity-tracking", "settings": {"seed": 0}})
    assert ("per_env" in results[0]) == per_env
    found = compare(*results)["differences"]["e_upper"]
    assert found["difference"] == pytest.approx(-0.25)
    assert found.get("pairs") == (2 if per_env else None)
    assert found["ci95"] == (pytest.approx([-0.45, -0.05]) if per_env else pytest.approx([-0.69, 0.20], abs=0.02))


def test_every_envs_figures_are_those_behind_the_means():
    protocol = Impact(num_envs=3, per_env=True)
    t = trajectory(steps=200, envs=3)
    t.hand_error[:] = torch.tensor([0.1, 0.2, 0.4])[:, None]
    t.fell[150, 2] = True
    env = HumanoidEnv(protocol.configure(HumanoidEnvConfig(num_threads=1)))
    result = protocol.measure(t, env)
    assert result["per_env"]["stood"] == [1.0, 1.0, 0.0]
    assert result["per_env"]["e_ee_hit"] == pytest.approx([0.1, 0.2, 0.4])
    assert result["per_env"]["recovery_s"][2] is None
    assert result["metrics"]["e_ee_hit"]["mean"] == pytest.approx(0.7 / 3.0)
    assert result["metrics_without_falls"]["e_ee_hit"]["mean"] == pytest.approx(0.15)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--mode", "flying"], "mode 'flying' is unknown"),
        (["--hand", "foot"], "force.hand 'foot' is unknown"),
        (["--num-envs", "0"], "num_envs"),
        (["--window", "1", "0.5"], "window[1]"),
        (["--episode-seconds", "1.5"], "episode_seconds"),
        (["--place", "moon"], "force.place 'moon' is unknown"),
        (["--pelvis", "glued"], "pelvis 'glued' is unknown"),
        (["--motion", "mixture", "walk"], "stand alone"),
        (["--motion", "none", "walk"], "stand alone"),
        (["--motion"], "motion must name clips"),
        (["--motion", "none", "--arm-pose", "9", "0", "0", "0"], "arm_pose[0]"),
        (["--motion", "none", "--arm-pose", "0", "0", "0"], "arm_pose must have 4 numbers"),
        (["--arm-pose", "0", "0", "0", "0"], "held only with motion 'none'"),
        (["--upper-actions", "nobody"], "upper_actions 'nobody' is unknown"),
        (["--upper-actions", "1.1"], "upper_actions must lie in [0.0, 1.0]"),
        (["--upper-actions", "nan"], "upper_actions must"),
        (["--library", "nowhere.npz"], "nowhere.npz"),
        (["--checkpoint", "cotap-gaols"], "'cotap-gaols' does not exist"),
        (["--force", "nan", "0", "0"], "force.force[0]"),
        (["--motion", "moonwalk"], "no clip is called 'moonwalk'"),
    ],
)
def test_bad_options_are_named(options, message, capsys, shipped):  # noqa: ARG001
    assert main(["impact", "--num-envs", "1", *options]) == 2
    assert message in capsys.readouterr().err
    assert math.isfinite(Impact().seconds)
