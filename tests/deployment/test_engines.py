"""Engines behind one interface: MuJoCo's conventions, the same robot, torque limits, holding, pushing."""

from __future__ import annotations

import builtins

import mujoco
import numpy as np
import pytest
import torch

from cotap.compliance.dynamics import joint_inertia
from cotap.deployment.engines import EngineConfig, EngineState, PointForce, make_engine
from cotap.deployment.joint_law import damped_law, pd_law
from cotap.deployment.rotors import rotor_inertias, with_rotors
from cotap.envs.state import StateReader
from cotap.robots.chains import arm_chains, arm_inertias

ENGINES = ["mujoco", "pybullet"]


@pytest.fixture
def gains(spec):
    return tuple(np.array([getattr(j, name) for j in spec.joints]) for name in ("kp", "kd", "default_rad"))


@pytest.fixture(params=ENGINES)
def engine(request, spec):
    yield from made(request.param, spec)


@pytest.fixture(params=ENGINES)
def any_engine(request, any_spec):
    yield from made(request.param, any_spec)


def made(name, spec):
    if name == "pybullet":
        pytest.importorskip("pybullet")
    engine = make_engine(EngineConfig(engine=name), spec)
    yield engine
    engine.close()


def tumbling(default):
    rng = np.random.default_rng(0)
    attitude = rng.standard_normal(4)
    qpos = np.concatenate(([0.3, -0.2, 3.0], attitude / np.linalg.norm(attitude), default + 0.1))
    return qpos, rng.uniform(-1.0, 1.0, 6 + len(default))


def test_states_and_feet_mean_the_same_everywhere(any_engine, any_model, any_spec):
    engine, model, spec = any_engine, any_model, any_spec
    qpos, qvel = tumbling(np.array([j.default_rad for j in spec.joints]))
    engine.reset(qpos, qvel, 1.0)
    np.testing.assert_allclose(engine.qpos, qpos, atol=1e-9)
    np.testing.assert_allclose(engine.qvel, qvel, atol=1e-9)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(model, data)
    state = StateReader(spec, EngineState(engine), torch.float64).read()
    for i, foot in enumerate(spec.feet):
        for kind, field in (("pos", "foot_pos_w"), ("vel", "foot_velocity_w"), ("up", "foot_up_w")):
            expected = data.sensor(f"{foot.side}_foot_{kind}").data
            np.testing.assert_allclose(getattr(state, field)[0, i].numpy(), expected, atol=1e-5)


def test_flight_keeps_momentum_and_falls_with_g(engine, model, gains):
    """What no motor can change: the centre of mass of a robot in the air."""
    kp, kd, default = gains
    qpos, qvel = tumbling(default)
    engine.reset(qpos, qvel, 1.0)
    reference = mujoco.MjData(model)
    heights = []
    for _ in range(3):
        reference.qpos[:] = engine.qpos
        mujoco.mj_kinematics(model, reference)
        mujoco.mj_comPos(model, reference)
        heights.append(reference.subtree_com[0].copy())
        engine.advance(pd_law(kp, kd, default), 100, ())
    fall = heights[2] - 2.0 * heights[1] + heights[0]
    np.testing.assert_allclose(fall, [0.0, 0.0, -9.81 * 0.01], atol=2e-3)


def angular_momentum(engine, model, rotors):
    """About the centre of mass (3,), by MuJoCo; `rotors` are what links have beside, about their joints' axes."""
    data, velocity = mujoco.MjData(model), np.zeros(6)
    data.qpos[:], data.qvel[:] = engine.qpos, engine.qvel
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    total = data.subtree_angmom[0].copy()
    for name, amount in rotors.items():
        body = model.body(name).id
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
        axis = data.xaxis[model.body_jntadr[body]]
        total += amount * axis * (axis @ velocity[:3])
    return total


def test_flight_keeps_angular_momentum(engine, model, spec, gains):
    """Within a second: what the damping that Bullet has by default took would be four times as much."""
    kp, kd, default = gains
    rotors = {} if "Mujoco" in type(engine).__name__ else rotor_inertias(spec)
    qpos, qvel = tumbling(default)
    qpos[2] = 20.0
    engine.reset(qpos, qvel, 1.0)
    before = angular_momentum(engine, model, rotors)
    engine.advance(pd_law(kp, kd, default), 1000, ())
    np.testing.assert_allclose(angular_momentum(engine, model, rotors), before, atol=0.01)


def test_joints_settle_where_pd_and_gravity_have_them(engine, model, spec, gains):
    """Base held: statics of the nominal model, whichever engine."""
    kp, kd, default = gains
    qpos = np.concatenate(([0.0, 0.0, 1.6, 1.0, 0.0, 0.0, 0.0], default))
    engine.reset(qpos, np.zeros(25), 1.0)
    engine.hold(True)
    hand, shin = spec.arms[0], spec.chain(spec.feet[1].body, spec.base_body)[-2].name
    on_hand = PointForce(hand.hand_body, hand.hand_point, np.array([0.0, 0.0, -10.0]))
    on_knee = PointForce(shin, (0.0, 0.0, 0.0), np.array([8.0, 3.0, 0.0]))
    engine.advance(pd_law(kp, kd, default), 3000, [on_hand, on_knee])
    np.testing.assert_allclose(engine.qpos[:3], qpos[:3], atol=1e-3)
    data = mujoco.MjData(model)
    data.qpos[:] = engine.qpos
    mujoco.mj_forward(model, data)
    static = data.qfrc_bias[6:]
    for force in (on_hand, on_knee):
        body, jacobian = data.body(force.body), np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, jacobian, None, body.xpos + body.xmat.reshape(3, 3) @ force.point, body.id)
        static = static - jacobian[:, 6:].T @ force.force_w
    np.testing.assert_allclose(kp * (default - engine.qpos[7:]), static, atol=0.15)
    engine.hold(False)
    engine.advance(damped_law(kd), 300, ())
    assert engine.qpos[2] < 1.5


def test_torque_limits_hold(engine, spec, gains):
    """A joint that is to jump by ten radians moves as its limit lets it, not as its gain would."""
    kp, kd, default = gains
    low = make_engine(EngineConfig(engine=type(engine).__name__.removesuffix("Engine").lower(),
                                   torque_limit_scale=0.1), spec)  # fmt: skip
    elbow = spec.joint_names.index("left_elbow")
    rates = []
    for one in (engine, low):
        one.reset(np.concatenate(([0.0, 0.0, 3.0, 1.0, 0.0, 0.0, 0.0], default)), np.zeros(25), 1.0)
        target = default.copy()
        target[elbow] -= 10.0
        one.advance(pd_law(kp, 0.0 * kd, target), 5, ())
        rates.append(one.qvel[6 + elbow])
    low.close()
    assert rates[0] == pytest.approx(10.0 * rates[1], rel=0.25)
    # 18 Nm for 5 ms on 0.1 kg m^2, a forearm, and an upper arm that gives way where rotors are part of links.
    assert -18.0 * 0.005 / 0.05 < rates[0] < -18.0 * 0.005 / 0.2


def test_links_that_touch_are_named(engine, spec, gains):
    kp, kd, default = gains
    crossed = default.copy()
    crossed[spec.indices(["left_hip_roll", "right_hip_roll"])] = -0.27, 0.27  # soles 3 cm beyond each other
    for pose, legs in ((default, set()), (crossed, {"left", "right"})):
        engine.reset(np.concatenate(([0.0, 0.0, 3.0, 1.0, 0.0, 0.0, 0.0], pose)), np.zeros(25), 1.0)
        engine.advance(pd_law(kp, kd, pose), 1, ())
        touching = engine.touching()
        assert {name.split("_")[0] for pair in touching for name in pair} == legs
        assert all(first < second for first, second in touching)
    assert any("ankle" in first and "ankle" in second for first, second in touching)


def test_pairs_that_never_collide_touch_in_no_engine(any_engine, any_spec):
    """Shapes of the made-up robot's pelvis and hips overlap."""
    pose = np.array([j.default_rad for j in any_spec.joints])
    gains = [np.array([getattr(j, name) for j in any_spec.joints]) for name in ("kp", "kd")]
    any_engine.reset(np.concatenate(([0.0, 0.0, 3.0, 1.0, 0.0, 0.0, 0.0], pose)), np.zeros(6 + len(pose)), 1.0)
    any_engine.advance(pd_law(*gains, pose), 1, ())
    assert any_engine.touching() == set()


def test_heavier_robots_sag_more(engine, spec, gains):
    kp, kd, default = gains
    sag = []
    for scale in (1.0, 1.2):
        engine.reset(np.concatenate(([0.0, 0.0, 1.6, 1.0, 0.0, 0.0, 0.0], default)), np.zeros(25), scale)
        engine.hold(True)
        engine.advance(pd_law(kp, kd, default), 1500, ())
        sag.append((engine.qpos[7:] - default)[spec.indices(["left_elbow", "right_elbow"])])
    np.testing.assert_allclose(sag[1] / sag[0], 1.2, rtol=0.03)


def test_rotors_keep_the_diagonal_of_the_inertia(spec):
    """Of the arms at zero angles, against rotors at the joints."""
    zero = torch.zeros(1, 2, 4, dtype=torch.float64)
    diagonals = []
    for robot in (spec, with_rotors(spec)):
        pose = arm_chains(robot, torch.float64).pose(zero)
        full = joint_inertia(arm_inertias(robot, torch.float64), pose)
        diagonals.append(full.diagonal(dim1=-2, dim2=-1).numpy())
    np.testing.assert_allclose(diagonals[1], diagonals[0], rtol=0.02)
    given = rotor_inertias(spec)
    assert given["left_ankle_link"] == given["right_hip_yaw_link"] == pytest.approx(0.1)
    assert given["left_knee_link"] == given["left_hip_pitch_link"] == pytest.approx(0.0, abs=1e-9)
    assert given["left_shoulder_pitch_link"] == pytest.approx(0.0, abs=1e-6)  # oblique: elbow and shoulder yaw share it


def test_an_engine_that_is_not_installed_is_named(spec, monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name.startswith("pybullet"):
            raise ModuleNotFoundError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ModuleNotFoundError, match=r"pip install -e '\.\[pybullet\]'"):
        make_engine(EngineConfig(engine="pybullet"), spec)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"engine": "mujuco"}, "did you mean 'mujoco'"),
        ({"timestep": 0.1}, "timestep must lie in"),
        ({"collision": "hands"}, "collision 'hands' is unknown"),
        ({"cone": "round"}, "cone 'round' is unknown"),
        ({"engine": "pybullet", "collision": "feet"}, "pybullet has full collision"),
        ({"friction": 0.0}, "friction must lie in"),
    ],
)
def test_bad_settings_are_named(fields, message, spec):
    with pytest.raises(ValueError, match=message):
        make_engine(EngineConfig(**fields), spec)
