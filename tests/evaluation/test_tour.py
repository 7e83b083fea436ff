"""The punch tour as a whole: stances, what is drawn, that legs alone are the policy's, the command, the table."""

from __future__ import annotations

import json
import math
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from cotap.compare import compare
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.evaluate import evaluate, main
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.rollout import idle
from cotap.evaluation.tour import protocol
from cotap.evaluation.tour.field import FIELD, beside_the_field, field_table
from cotap.evaluation.tour.protocol import SEED_OFFSET, Tour
from cotap.evaluation.tour.stance import tour_stance
from cotap.robots import g1, h1
from cotap.robots.mjcf import build_model

SHORT = {"num_envs": 3, "episode_seconds": 2.0, "waypoints": 2}
ARGUMENTS = ["--num-envs", "2", "--episode-seconds", "1.2", "--waypoints", "2", "--threads", "1"]


def test_the_stance_of_the_g1_is_the_published_one():
    stance = tour_stance(g1())
    leg, arm = [-0.312, 0.0, 0.0, 0.669, -0.363, 0.0], [0.2, 0.2, 0.0, 0.6, 0.0, 0.0, 0.0]
    right = [0.2, -0.2, 0.0, 0.6, 0.0, 0.0, 0.0]
    assert stance.angles.tolist() == pytest.approx([*leg, *leg, 0.0, 0.0, 0.0, *arm, *right])
    assert stance.crane_height_m == pytest.approx(0.793)
    assert stance.fallen_height_m == pytest.approx(0.20)
    inertia = 2 * [*[0.003610] * 5, 0.00425, 0.00425]  # wrists pitch and yaw by a smaller motor of a larger gear
    assert stance.arm_kp.tolist() == pytest.approx([i * (20.0 * math.pi) ** 2 for i in inertia], rel=1e-4)
    assert stance.arm_kd.tolist() == pytest.approx([4.0 * i * 20.0 * math.pi for i in inertia], rel=1e-4)


def test_under_the_published_crane_joints_stay_in_the_stance(any_spec):
    """Its rule, in MuJoCo itself: for 3 s of 2 ms the pelvis is put back before every step, motors hold the stance."""
    stance, model = tour_stance(any_spec), build_model(any_spec, "full", 0.002)
    data = mujoco.MjData(model)
    start = stance.start().double().numpy()
    data.qpos[:] = start
    for _ in range(1500):
        data.qpos[:7], data.qvel[:6] = start[:7], 0.0
        data.ctrl[:] = [j.kp * angle for j, angle in zip(any_spec.joints, start[7:], strict=True)]
        mujoco.mj_step(model, data)
    assert data.ncon == 0  # the feet are in the air
    np.testing.assert_allclose(data.qpos[7:], start[7:], atol=1e-6)
    np.testing.assert_allclose(data.qvel[6:], 0.0, atol=1e-6)


def test_the_stance_of_the_h1_has_the_same_angles_and_its_own_heights_and_gains():
    """Both stand on straight shanks and thighs: 0.400 m and 0.400 m against 0.31 m and 0.30 m."""
    stance, spec = tour_stance(h1()), h1()
    angles = dict(zip(spec.joint_names, stance.angles.tolist(), strict=True))
    for side, sign in (("left", 1.0), ("right", -1.0)):
        part = {k.removeprefix(f"{side}_"): v for k, v in angles.items() if k.startswith(side)}
        assert part == pytest.approx({
            "hip_yaw": 0.0, "hip_roll": 0.0, "hip_pitch": -0.312, "knee": 0.669, "ankle": -0.363,
            "shoulder_pitch": 0.2, "shoulder_roll": 0.2 * sign, "shoulder_yaw": 0.0, "elbow": 0.6,
        })  # fmt: skip
    # Hips 0.1742 m below the pelvis, thigh and shank 0.4 m each, sole 0.07 m below the ankle.
    standing = 0.1742 + 0.4 * (math.cos(0.312) + math.cos(0.357)) + 0.07
    assert stance.crane_height_m / 0.793 == pytest.approx(standing / 0.7565, rel=2e-3)
    assert stance.fallen_height_m == pytest.approx(0.2 / 0.793 * stance.crane_height_m)
    assert stance.chin_height_m == pytest.approx(0.42999 + 0.1 / 0.793 * stance.crane_height_m)
    assert stance.arm_kp.tolist() == pytest.approx(8 * [394.784], rel=1e-5)  # of rotors of 0.1 kg m^2
    assert stance.arm_kd.tolist() == pytest.approx(8 * [25.1327], rel=1e-5)


def test_a_stance_is_its_own_mirror_image_and_within_limits(any_spec):
    stance = tour_stance(any_spec)
    angles = dict(zip(any_spec.joint_names, stance.angles.tolist(), strict=True))
    for j in any_spec.joints:
        assert angles[j.name] == pytest.approx(j.mirror_sign * angles[j.mirror_name])
        assert j.range_rad[0] <= angles[j.name] <= j.range_rad[1]


def test_a_run_is_the_same_tour_whatever_others_there_are_and_another_for_another_seed(any_spec):
    stance = tour_stance(any_spec)
    many, one = (Tour(**SHORT).draw(any_spec, stance, runs) for runs in (range(4), range(2, 3)))
    for all_runs, alone in zip(many, one, strict=True):
        assert torch.equal(all_runs[2], alone[0])
        assert not torch.equal(all_runs[2], all_runs[3])
    assert not torch.equal(Tour(**SHORT, seed=1).draw(any_spec, stance, range(2, 3))[0], one[0])


def test_no_training_can_have_the_seed_of_a_tour():
    with pytest.raises(ValueError, match="seed"):
        HumanoidEnvConfig(seed=SEED_OFFSET).check()
    for seed in (7, 2**62):  # the largest
        assert Tour(seed=seed).punches().seed == SEED_OFFSET + seed
        Tour(seed=seed).check()


def started(robot: str, law: str = "pd", **fields) -> tuple[Tour, HumanoidEnv]:
    tour = Tour(**SHORT | fields)
    cfg = HumanoidEnvConfig(robot, num_threads=1)
    cfg.upper_body = LawOptions(method=law).configure()
    env = HumanoidEnv(tour.configure(cfg))
    tour.prepare(env)
    return tour, env


def test_physics_runs_at_2_ms_and_nothing_is_randomised(robot):
    _, env = started(robot)
    assert env.sim.model.opt.timestep == pytest.approx(0.002)
    assert env.dt == pytest.approx(0.02)
    assert (env.sim.field("body_mass") == env.sim.field("body_mass")[0]).all()


@pytest.mark.parametrize("law", ["pd", "soft-pd"])
def test_arms_have_the_tour_s_gains_unless_a_law_drives_them(robot, law):
    _, env = started(robot, law)
    stance, upper = tour_stance(env.spec), env.action_slices["upper"]
    kp, kd = env.randomizer.gains()
    own = torch.tensor([[j.kp, j.kd] for j in env.spec.joints])
    arms = torch.stack((stance.arm_kp, stance.arm_kd), 1) if law == "pd" else own[upper]
    torch.testing.assert_close(torch.stack((kp[0, upper], kd[0, upper]), 1), arms)
    torch.testing.assert_close(torch.stack((kp[0], kd[0]), 1)[: env.num_lower], own[: env.num_lower])
    if law == "pd":
        torch.testing.assert_close(-env.sim.field("actuator_biasprm")[0, :, 1].float(), kp[0])


def test_robots_begin_in_the_stance_and_arms_follow_the_walk(robot, monkeypatch):
    """Targets of the arms are the tour's, to the digit, whatever the policy asks of them."""
    tour, env = started(robot, force_size=0.0)
    seen: list[tuple[torch.Tensor, ...]] = []
    step = env.step

    def watched(actions: torch.Tensor):
        before = env.sim.qpos.clone()
        out = step(actions)
        seen.append((before, env.actuation.current.clone()))
        return out

    monkeypatch.setattr(env, "step", watched)
    upper, lower = env.action_slices["upper"], env.action_slices["lower"]
    tour.evaluate(env, lambda obs: 0.1 * torch.ones(len(obs["policy"]), env.num_actions))
    stance = tour.stance
    torch.testing.assert_close(seen[0][0].float(), stance.start().expand(3, -1))
    for k in (0, 10, 24, 25, 30):
        expected, _ = protocol.arms_at(tour._targets, 0.02 * (k + 1))
        torch.testing.assert_close(seen[k][1][:, upper], expected)
        legs = env.joint_targets.default[lower] + 0.1 * env.joint_targets.scale[lower]
        torch.testing.assert_close(seen[k][1][:, lower], legs.expand(3, -1))


def test_punches_land_when_they_should(robot, monkeypatch):
    tour, env = started(robot, waypoints=2)
    struck = []
    step = env.step

    def watched(actions: torch.Tensor):
        out = step(actions)
        struck.append(bool(env.sim.xfrc.any()))
        return out

    monkeypatch.setattr(env, "step", watched)
    tour.evaluate(env, idle(env))
    expected = [5, 6, 7, 8, 55, 56, 57, 58]
    assert [k for k, on in enumerate(struck) if on] == expected[: sum(k < len(struck) for k in expected)]


def test_a_fall_is_a_low_pelvis_and_nothing_else(robot):
    """Robots without power: who lies down has fallen, and is not set up again meanwhile."""
    tour, env = started(robot, force_size=0.0, episode_seconds=4.0)
    without = torch.zeros(env.num_actions)
    env.randomizer.set_nominal_gains(slice(None), without, without)
    heights = []
    original = env.step

    def watched(actions: torch.Tensor):
        out = original(actions)
        heights.append((env.sim.qpos[:, 2].clone(), out[3]["falls"]))
        return out

    env.step = watched
    measured = tour.evaluate(env, idle(env))
    height, falls = (torch.stack(part) for part in zip(*heights, strict=True))
    assert not falls.any()  # the environment ends no episode
    low = height < tour.stance.fallen_height_m
    expected = torch.where(low.any(0), 0.02 * (low.long().argmax(0) + 1), 4.0)
    assert low.any()
    assert measured["metrics"]["survival_s"]["mean"] == pytest.approx(float(expected.mean()), abs=1e-4)
    assert measured["num_falls"] == int(low.any(0).sum())


@pytest.mark.slow
@pytest.mark.parametrize("law", [[], ["--method", "cotap", "--stiffness", "300"]])
def test_the_command_writes_json_table_and_plot(checkpoints, robot, law, tmp_path, capsys):
    out, plot = tmp_path / "tour.json", tmp_path / "tour.png"
    options = [*ARGUMENTS, *law, "--json", str(out), "--plot", str(plot)]
    assert main(["tour", "--checkpoint", str(checkpoints(robot)), *options]) == 0
    result = json.loads(out.read_text())
    assert result["method"] == ("cotap" if law else "pd")
    assert (result["num_envs"], result["settings"]["env"]["robot"]) == (2, robot)
    assert 0.0 < result["metrics"]["survival_s"]["mean"] <= 1.2
    assert [s["end_s"] for s in result["segments"]] == pytest.approx([0.6, 1.2])
    shown = capsys.readouterr().out
    assert f"tour, {result['method']}, arms moving: " in shown
    assert "gr00t" not in shown  # a part of the tour is not comparable
    assert plot.read_bytes()[:4] == b"\x89PNG"


def test_the_same_seed_gives_the_same_scores(checkpoint):
    arguments = ["tour", "--checkpoint", str(checkpoint), *ARGUMENTS, "--per-env"]
    results = [evaluate([*arguments, "--seed", s]) for s in ("3", "3", "4")]
    first, again, other = ({k: v for k, v in r.items() if k not in ("seconds", "settings")} for r in results)
    assert first == again
    assert first != other
    rows = compare(*results[:2])["differences"]  # run by run
    assert rows["survival_s"] | {"a": 0, "b": 0} == {"a": 0, "b": 0, "difference": 0.0, "ci95": [0.0, 0.0], "pairs": 2,
                                                     "better": "more", "b_is": "not distinguishable"}  # fmt: skip
    assert "pairs" not in rows["position_error"]  # which has no figure of a run


@pytest.mark.parametrize(
    ("options", "message"),
    [(["--waypoints", "0"], "waypoints must be a positive integer"), (["--force-size", "-1"], "punches.force_n"),
     (["--episode-seconds", "91.01"], "a multiple of 0.02 s"), (["--episode-seconds", "1.8"], "punches.segment_s"),
     (["--upper-actions", "x"], "upper_actions"), (["--engine", "physx"], "engine 'physx' is unknown"),
     (["--engine", "pybullet", "--randomize"], "randomize does nothing in pybullet, got True")],
)  # fmt: skip
def test_bad_options_are_named(options, message, capsys):
    assert main(["tour", *options]) == 2
    assert message in capsys.readouterr().err


def test_a_policy_of_another_control_rate_is_refused():
    with pytest.raises(ValueError, match=r"control step of 0\.02 s, got 0\.01"):
        Tour().configure(HumanoidEnvConfig(control_dt=0.01))


def whole(robot: str, **settings) -> dict:
    measure = {"mean": 0.5, "std": 0.1, "ci95": [0.4, 0.6], "n": 512}
    names = ("survival_s", "completed_fraction", "position_error", "yaw_error", "energy")
    given = {
        "episode_seconds": 90.0,
        "waypoints": 18,
        "force_size": 500.0,
        "engine": "mujoco",
        "env": {"robot": robot},
    } | settings
    return {"settings": given, "method": "pd", "metrics": dict.fromkeys(names, measure)}


def test_a_whole_tour_of_the_g1_is_shown_beside_the_field():
    shown = beside_the_field(whole("g1"))
    (ours,) = (line for line in shown.splitlines() if "this policy" in line)
    assert "| 0.5 (0.4 to 0.6) | 50.0 (40.0 to 60.0) | 50.0 (40.0 to 60.0) | 28.6 (22.9 to 34.4) | 0.0 " in ours
    assert "| homie | 78.2 / 79 | 55 / 58 | 17 / 18 | 32 / 36 | 10.3 / 9.3 |" in shown
    assert beside_the_field(whole("h1")) == beside_the_field(whole("g1", waypoints=12)) == ""


def test_the_field_is_in_order_and_in_the_documentation():
    survival = [sum(row.survival_s) for row in FIELD]
    assert survival == sorted(survival, reverse=True)
    assert field_table() in (Path(__file__).parents[2] / "docs/tour.md").read_text()
