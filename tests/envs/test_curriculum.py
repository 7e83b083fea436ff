"""What grows and what fades with the samples; the wrench of the first steps."""

from __future__ import annotations

import dataclasses
import math

import mujoco
import numpy as np
import pytest
import torch
from env_tools import NOMINAL, drive, felt, hold_still, knock_over, mujoco_of, zeros

from cotap.compliance.kinematics import ChainPose
from cotap.envs.commands import Command, CommandConfig
from cotap.envs.curriculum import AssistConfig, AssistWrench, Curriculum, CurriculumConfig, RampConfig
from cotap.envs.external_forces import ExternalForceConfig
from cotap.envs.pushes import PushConfig
from cotap.envs.state import RobotState
from cotap.robots.mjcf import torso_inertia


@pytest.mark.parametrize(("samples", "share"), [(0, 0.2), (100, 0.2), (150, 0.4), (200, 0.6), (300, 1.0), (1e12, 1.0)])
def test_a_ramp_by_hand(samples, share):
    assert RampConfig(100, 300, first=0.2).share(samples) == pytest.approx(share)


def test_a_ramp_that_is_none_is_full_at_once():
    assert RampConfig().share(0) == 1.0
    assert [RampConfig(100, 100, first=0.2).share(samples) for samples in (0, 99, 100)] == [0.2, 0.2, 1.0]  # a step


@pytest.mark.parametrize(
    ("ramp", "match"),
    [
        (RampConfig(5.0, 4.0), r"here\.start_samples"),
        (RampConfig(0.0, math.inf), r"here\.full_samples"),
        (RampConfig(0.0, 1.0, 1.5), r"here\.first"),
    ],
)
def test_bad_ramps_are_named(ramp, match):
    with pytest.raises(ValueError, match=match):
        ramp.check("here")


@pytest.mark.parametrize(
    ("samples", "share"), [(0, 1.0), (100, 1.0), (150, 0.5625), (250, 0.0625), (300, 0.0), (9e9, 0.0)]
)
def test_assistance_fades_as_a_square_to_nothing(samples, share):
    assert AssistConfig(enabled=True, full_samples=100, end_samples=300).share(samples) == pytest.approx(share)
    assert AssistConfig(enabled=False, full_samples=100, end_samples=300).share(samples) == 0.0


def test_a_curriculum_counts_samples_while_few_fall():
    """By hand, at steps of 1 s: the average over 10 s of falls moves by a tenth of the way."""
    curriculum = Curriculum(CurriculumConfig(max_falls_per_s=0.02), dt=1.0)
    nobody, one = torch.zeros(4, dtype=torch.bool), torch.tensor([False, True, False, False])
    curriculum.step(nobody, 100)
    assert curriculum.state_dict() == {"samples": 100, "falls_per_s": 0.0, "arm_motion": 1.0}
    curriculum.step(one, 100)  # a quarter fell: 0.1 * 0.25 = 0.025
    assert curriculum.falls_per_s == pytest.approx(0.025)
    assert curriculum.samples == 100
    for average, samples in ((0.0225, 100), (0.02025, 100), (0.018225, 200), (0.0164025, 300)):
        curriculum.step(nobody, 100)
        assert curriculum.falls_per_s == pytest.approx(average)
        assert curriculum.samples == samples
    other = Curriculum(CurriculumConfig(), dt=1.0)
    other.load_state_dict(curriculum.state_dict())
    assert other.state_dict() == curriculum.state_dict()


def test_pushes_do_not_grow_while_many_fall(make_env, robot):
    """Whatever the samples; the assistance fades all the same."""
    pushes = PushConfig(enabled=True, ramp=RampConfig(0.0, 100.0))
    env = make_env(
        4, robot=robot, assist=AssistConfig(True, full_samples=0, end_samples=100),
        curriculum=CurriculumConfig(max_falls_per_s=0.0), forces=ExternalForceConfig(pushes=pushes),
    )  # fmt: skip
    knock_over(env, 0)
    _, _, done, extras = env.step(zeros(env))
    assert done.tolist() == [True, False, False, False]
    for _ in range(30):
        _, _, _, extras = env.step(zeros(env))
    assert (env.samples, env.curriculum.samples) == (4 * 31, 0)
    env.forces.pushes._next_s[:] = 0.0
    env.step(zeros(env))
    assert env.forces.pushes._left_s.min() > 0.0
    assert not env.forces.pushes.current().any()  # pushes of no size
    assert extras["log"]["/curriculum/assist"].item() == 0.0
    assert extras["log"]["/curriculum/samples"].item() == 0.0


def test_arms_move_less_while_many_fall():
    """By 100 of 400 samples a step. Disturbances wait until arms move wholly again."""
    curriculum = Curriculum(CurriculumConfig(max_falls_per_s=0.02, arm_motion_samples=400), dt=1.0)
    nobody = torch.zeros(1000, dtype=torch.bool)
    for falls, after, samples in (
        (0.0, 1.0, 100), (0.03, 0.75, 100), (0.021, 0.5, 100), (0.019, 0.75, 100), (0.011, 1.0, 100), (0.0, 1.0, 200),
        (0.021, 0.75, 200),
    ):  # fmt: skip
        curriculum.falls_per_s = falls / 0.9  # a step without falls takes a tenth away
        curriculum.step(nobody, 100)
        assert curriculum.falls_per_s == pytest.approx(falls)
        assert curriculum.arm_motion == pytest.approx(after)
        assert curriculum.samples == samples
    for _ in range(9):
        curriculum.step(~nobody, 100)
    assert curriculum.arm_motion == 0.0


def test_arms_that_are_asked_to_move_wholly_do_so_whatever_they_did_before():
    curriculum = Curriculum(CurriculumConfig(), dt=1.0)
    curriculum.load_state_dict({"samples": 5, "falls_per_s": 0.0, "arm_motion": 0.8})
    curriculum.step(torch.zeros(4, dtype=torch.bool), 4)
    curriculum.step(torch.zeros(4, dtype=torch.bool), 4)
    assert (curriculum.arm_motion, curriculum.samples) == (1.0, 9)


def test_arms_move_wholly_where_nothing_else_is_asked_for():
    curriculum = Curriculum(CurriculumConfig(), dt=1.0)
    for _ in range(9):
        curriculum.step(torch.ones(4, dtype=torch.bool), 10**9)
    assert curriculum.arm_motion == 1.0


def test_arms_rest_where_all_fall_and_move_again(make_env, robot):
    cfg = CurriculumConfig(max_falls_per_s=0.02, arm_motion_samples=16.0)
    env = make_env(4, robot=robot, curriculum=cfg)
    default, off = env.motions.default, []
    env.curriculum.falls_per_s = 1.0
    for step in range(24):
        if step == 12:
            env.curriculum.falls_per_s = 0.0
        _, _, _, extras = env.step(zeros(env))
        off.append(float((env.motions.current().position - default).abs().max()))
        env.episode_length_buf[:] = 0
    assert off[0] > 0.05
    assert max(off[9:12]) < 1e-6
    assert float(extras["log"]["/curriculum/arm_motion"]) == env.curriculum.arm_motion == 1.0
    assert off[-1] > 0.05


def test_a_curriculum_goes_on_with_its_envs(make_env, robot):
    env, other = (make_env(2, robot=robot) for _ in range(2))
    drive(env, 3)
    env.curriculum.falls_per_s, env.curriculum.arm_motion = 0.5, 0.25
    other.load_state_dict(env.state_dict())
    assert other.curriculum.state_dict() == {"samples": 6, "falls_per_s": 0.5, "arm_motion": 0.25}


def test_a_bad_curriculum_is_named():
    with pytest.raises(ValueError, match=r"curriculum\.max_falls_per_s"):
        CurriculumConfig(-0.1).check()
    with pytest.raises(ValueError, match=r"curriculum\.arm_motion_samples"):
        CurriculumConfig(arm_motion_samples=-1.0).check()
    with pytest.raises(ValueError, match=r"curriculum\.arm_motion "):
        Curriculum(CurriculumConfig(), 0.02).load_state_dict({"samples": 0, "falls_per_s": 0.0, "arm_motion": 1.5})


def test_assistance_may_end_all_at_once():
    cfg = AssistConfig(enabled=True, full_samples=100, end_samples=100)
    assert (cfg.share(99), cfg.share(100)) == (1.0, 0.0)


@pytest.mark.parametrize(
    ("cfg", "match"),
    [
        (AssistConfig(full_samples=9.0, end_samples=5.0), "assist.end_samples"),
        (AssistConfig(velocity_gain=math.nan), "assist.velocity_gain"),
        (AssistConfig(weight_share=1.5), "assist.weight_share"),
    ],
)
def test_bad_fields_are_named(cfg, match):
    with pytest.raises(ValueError, match=match):
        cfg.check()


CFG = AssistConfig(
    enabled=True, upright_stiffness=0.8, upright_damping=0.08, yaw_gain=0.06, velocity_gain=0.6, force_limit=0.3,
    weight_share=0.25,
)  # fmt: skip
TILT = 0.2
HEAVY = torch.full((3,), 1e3)


def turned(axis: str, angle: float) -> torch.Tensor:
    c, s = math.cos(angle), math.sin(angle)
    rows = {"x": [[1, 0, 0], [0, c, -s], [0, s, c]], "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
            "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]]}  # fmt: skip
    return torch.tensor([rows[axis]], dtype=torch.float32)


def wrench(spec, heading=0.0, tilt=None, spin_w=(0, 0, 0), off=(0, 0), yaw_rate=0.0, below=0.0, climb=0.0):
    """Force over weight, and torque over weight times height, of a torso whose errors are these."""
    rotation = turned("z", heading) @ (turned(*tilt) if tilt else torch.eye(3).unsqueeze(0))
    zero = torch.zeros(1, 1)
    spin = torch.tensor([spin_w], dtype=torch.float32)
    state = RobotState(
        joint_pos=zero, joint_vel=zero, base_rotation_w=rotation, torso_pos_w=torch.tensor([[1.0, 2.0, 0.7]]),
        torso_rotation_w=rotation, heading_w=turned("z", heading),
        torso_linear_velocity_h=torch.tensor([[0.3 - off[0], -0.1 - off[1], climb]]),
        torso_angular_velocity_t=(rotation.transpose(1, 2) @ spin.unsqueeze(2)).squeeze(2), yaw_rate=spin[:, 2],
        projected_gravity_t=-rotation[:, 2], arms=ChainPose(zero, zero, zero, zero), foot_force=zero, foot_pos_w=zero,
        foot_velocity_w=zero, foot_up_w=zero, foot_forward_w=zero,
    )  # fmt: skip
    command = Command(
        torch.tensor([[0.3, -0.1]]), spin[:, 2] + yaw_rate, torch.zeros(1), torch.tensor([0.7 + below]), torch.zeros(1)
    )
    weight = spec.mass_kg * 9.81
    out = AssistWrench(CFG, spec, HEAVY, 0.02)(state, command)[0]
    return (out[:3] / weight).tolist(), (out[3:] / weight / spec.nominal_height_m).tolist()


@pytest.mark.parametrize(
    ("errors", "force", "torque"),
    [
        ({}, [0, 0, 0.25], [0, 0, 0]),
        # Leaning forward (about +y) is undone about -y, leaning left (about -x) about +x.
        ({"tilt": ("y", TILT)}, [0, 0, 0.25], [0, -0.8 * math.sin(TILT), 0]),
        ({"tilt": ("x", -TILT)}, [0, 0, 0.25], [0.8 * math.sin(TILT), 0, 0]),
        # In the world's frame: a robot that faces +y and leans forward is turned about +x.
        ({"heading": math.pi / 2, "tilt": ("y", TILT)}, [0, 0, 0.25], [0.8 * math.sin(TILT), 0, 0]),
        ({"spin_w": (0.5, -0.25, 3.0)}, [0, 0, 0.25], [-0.04, 0.02, 0]),  # rolling is damped, turning is not
        ({"heading": 1.0, "spin_w": (0.5, -0.25, 0.0)}, [0, 0, 0.25], [-0.04, 0.02, 0]),
        ({"yaw_rate": 0.3}, [0, 0, 0.25], [0, 0, 0.018]),
        ({"off": (0.1, -0.2)}, [0.06, -0.12, 0.25], [0, 0, 0]),
        ({"heading": math.pi / 2, "off": (0.1, -0.2)}, [0.12, 0.06, 0.25], [0, 0, 0]),
        ({"off": (3.0, 4.0)}, [0.18, 0.24, 0.25], [0, 0, 0]),  # no more than its limit
        ({"below": 0.3, "climb": 0.1}, [0, 0, 0.25], [0, 0, 0]),  # no more for one that sinks: it would hang
    ],
)
def test_the_wrench_by_hand_in_units_of_weight(any_spec, errors, force, torque):
    got = wrench(any_spec, **errors)
    assert got[0] == pytest.approx(force, abs=1e-5)
    assert got[1] == pytest.approx(torque, abs=1e-5)


def test_units_of_the_h1_are_its_weight(spec):
    """A quarter of 51.437 kg is lifted: 126.1 N."""
    still = AssistWrench(CFG, spec, HEAVY, 0.02)(*_at_rest())
    assert float(still[0, 2]) == pytest.approx(0.25 * 51.437 * 9.81, abs=1e-2)


def test_damping_stops_a_light_torso_within_a_step_at_most_one_and_a_half_times(spec):
    state, command = _at_rest()
    state = dataclasses.replace(state, torso_angular_velocity_t=torch.tensor([[0.1, -0.1, 0.0]]))
    command = dataclasses.replace(command, yaw_rate=torch.full((1,), 0.1))
    torque = AssistWrench(CFG, spec, torch.tensor([0.4, 0.2, 0.3]), 0.02)(state, command)[0, 3:]
    assert torque.tolist() == pytest.approx([-0.1 * 15.0, 0.1 * 15.0, 0.1 * 22.5])


def test_the_h1_is_damped_as_its_weight_says(spec, model):
    state, command = _at_rest()
    state = dataclasses.replace(state, torso_angular_velocity_t=torch.tensor([[1.0, 0.0, 0.0]]))
    command = dataclasses.replace(command, yaw_rate=torch.ones(1))
    torque = AssistWrench(CFG, spec, torch.from_numpy(torso_inertia(spec, model)), 0.02)(state, command)[0, 3:]
    lever = 51.437 * 9.81 * 1.0205
    assert torque.tolist() == pytest.approx([-0.08 * lever, 0.0, 0.06 * lever], rel=1e-4)


def test_it_shakes_no_robot_apart(make_env, robot):
    """In full, over a second and a half of random actions: a damper too strong for its step throws robots about."""
    env = make_env(16, robot=robot, assist=AssistConfig(enabled=True))
    drive(env, 75, scale=0.5)
    assert env.num_diverged == 0
    assert float(env.sim.qvel.abs().max()) < 60.0


def _at_rest():
    eye, zero = torch.eye(3).unsqueeze(0), torch.zeros(1, 3)
    names = {f.name: torch.zeros(1, 1) for f in dataclasses.fields(RobotState)}
    state = RobotState(**{
        **names, "torso_rotation_w": eye, "heading_w": eye, "torso_linear_velocity_h": zero, "yaw_rate": zero[:, 0],
        "torso_angular_velocity_t": zero, "torso_pos_w": zero,
    })  # fmt: skip
    return state, Command(zero[:, :2], zero[:, 0], zero[:, 0], zero[:, 0], zero[:, 0])


def test_it_acts_on_the_torso_and_nowhere_else(make_env, robot):
    env = make_env(3, robot=robot, assist=AssistConfig(enabled=True))
    env.step(zeros(env))
    torso = env.sim.model.body(env.spec.torso_body).id
    assert env.sim.xfrc[:, torso].abs().amax(1).min() > 1.0
    others = [b for b in range(env.sim.model.nbody) if b != torso]
    assert not env.sim.xfrc[:, others].any()
    assert not env.hand_force_w.any()  # it is no force that critics see or arms feel


def test_it_pulls_the_robot_as_a_rope_at_its_torso(make_env, robot):
    """Generalised forces against MuJoCo's own, of a pull at the torso's centre of mass and a couple."""
    assist = AssistConfig(enabled=True, velocity_gain=5.0, yaw_gain=0.2)
    fast = CommandConfig(velocity_x=(-9.0, 9.0), velocity_y=(-9.0, 9.0), yaw_rate=(-2.0, 2.0))
    env = make_env(2, robot=robot, assist=assist, randomization=NOMINAL, commands=fast)
    hold_still(env, stand=0.0)
    two = torch.tensor([2.0, -2.0])
    env.commands.set_velocity(torch.tensor([[9.0, 0.0], [0.0, 9.0]]), two, torch.ones(2, dtype=torch.bool))
    before = [mujoco_of(env, i) for i in range(2)]
    axis = [env.state.heading_w[0, :, 0], env.state.heading_w[1, :, 1]]  # forward, leftward
    env.step(zeros(env))
    weight, torso = env.spec.mass_kg * 9.81, env.spec.torso_body
    for i, (model, data) in enumerate(before):
        wrench = env.sim.xfrc[i, model.body(torso).id]
        np.testing.assert_allclose(wrench[:2], 0.3 * weight * axis[i][:2].double(), rtol=0.02, atol=0.01 * weight)
        assert float(wrench[5]) * float(two[i]) > 0.0
        out = np.zeros(model.nv)
        force, couple = wrench.numpy()[:3], wrench.numpy()[3:]
        mujoco.mj_applyFT(model, data, force, couple, data.body(torso).xipos, model.body(torso).id, out)
        np.testing.assert_allclose(felt(model, data, env.sim.xfrc[i]), out, atol=1e-9)
        np.testing.assert_allclose(out[:3], force, atol=1e-9)


def test_it_fades_as_samples_go_by(make_env, robot):
    """Two envs: 2 samples a step, all of it up to 8, none from 24 on."""
    assist = AssistConfig(enabled=True, full_samples=8, end_samples=24, velocity_gain=0.0)
    env = make_env(2, robot=robot, assist=assist, randomization=NOMINAL)
    lift = 0.25 * env.spec.mass_kg * 9.81
    torso = env.sim.model.body(env.spec.torso_body).id
    for step in range(15):
        *_, extras = env.step(zeros(env))
        share = max(0.0, min(1.0, (24 - 2 * step) / 16)) ** 2
        assert env.sim.xfrc[:, torso, 2].tolist() == pytest.approx([share * lift] * 2, abs=1e-3)
        after = max(0.0, min(1.0, (24 - 2 * (step + 1)) / 16)) ** 2
        assert float(extras["log"]["/curriculum/assist"]) == pytest.approx(after)
    assert not env.sim.xfrc.any()


def test_it_rights_a_robot_that_leans(make_env, robot):
    """In the air, limbs held: the tilt of a robot that is helped shrinks, or grows less, in every direction."""
    envs = [make_env(4, robot=robot, randomization=NOMINAL, assist=AssistConfig(enabled=e)) for e in (True, False)]
    tilt = []
    for env in envs:
        hold_still(env)
        env.reset_identical(3)
        env.sim.qpos[:, 2] += 1.0
        lean = [turned("z", yaw)[0] @ turned("y", 0.3)[0] for yaw in (0.0, 1.6, 3.1, -1.6)]
        for i, rotation in enumerate(lean):
            quat = np.zeros(4)
            mujoco.mju_mat2Quat(quat, rotation.double().numpy().flatten())
            env.sim.qpos[i, 3:7] = torch.from_numpy(quat)
        env.sim.qvel[:] = 0.0
        env.state = env.reader.read()
        for _ in range(8):
            env.step(zeros(env))
        tilt.append(env.state.projected_gravity_t[:, :2].norm(dim=1))
    assert (tilt[0] < tilt[1] - 0.01).all()
