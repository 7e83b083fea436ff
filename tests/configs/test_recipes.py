"""Recipes: `paper` has the paper's value wherever the paper names one (arXiv 2509.25443), and all are usable."""

from __future__ import annotations

import json
import math
from operator import attrgetter
from typing import Any

import pytest
import torch

from cotap.configs import BASE_RECIPES, DISTILL_RECIPES, BaseTraining, DistillTraining, from_plain, to_plain
from cotap.envs import HumanoidEnv
from cotap.envs.terminations import TerminationConfig
from cotap.robots import ROBOTS

ENV = {
    # Table II, domain randomisation. The mass of the base is that of the torso link.
    "randomization.enabled": True,
    "randomization.friction": (0.5, 1.25),
    "randomization.link_mass_scale": (0.9, 1.2),
    "randomization.base_mass_kg": (-1.0, 3.0),
    "randomization.delay_s": (0.0, 0.02),
    "randomization.kp_scale": (0.9, 1.1),
    "randomization.kd_scale": (0.9, 1.1),
    # Control at 50 Hz, absolute joint targets of the arms, five steps of history.
    "control_dt": 0.02,
    "actions.upper_mode": "absolute",
    "actions.upper_scale": 0.25,
    "actions.lower_scale": 0.25,
    "observations.history": 5,
    "observations.arm_torque": "actor",
    "observations.critic": "history",
    "observations.goals": False,
    # Hand loads as FALCON has them, and nothing that pushes.
    "forces.hand_loads.enabled": True,
    "forces.hand_loads.episode_share": 1.0,
    "forces.pushes.enabled": False,
    "forces.punches.force_n": 0.0,
}
"""Both stages."""
BASE = {
    **{f"env.{name}": value for name, value in ENV.items()},
    "env.num_envs": 4096,
    "env.upper_body.left.name": "pd",
    "env.upper_body.right.name": "pd",
    "env.rewards.upper.reference_closeness": 0.0,
    # FALCON's commands, gait, and PPO.
    "env.commands.velocity_x": (-1.0, 1.0),
    "env.commands.velocity_y": (-1.0, 1.0),
    "env.commands.yaw_rate": (-1.0, 1.0),
    "env.commands.height_offset": (-0.25, 0.0),
    "env.commands.stand_probability": 0.4,
    "env.commands.resample_s": (10.0, 10.0),
    "env.gait.period_s": 1.0,
    "env.forces.hand_loads.force_x": (-40.0, 40.0),
    "env.forces.hand_loads.force_y": (-40.0, 40.0),
    "env.forces.hand_loads.force_z": (-50.0, 5.0),
    "ppo.initial_std": 0.8,
    "ppo.entropy": 0.01,
    "ppo.epochs": 5,
    "ppo.mini_batches": 4,
    "ppo.steps": 24,
    "ppo.learning_rate": 1e-4,
    "ppo.lam": 0.95,
    "ppo.clip": 0.2,
    "ppo.hidden": (512, 256, 128),
    "ppo.symmetric": False,
    # FALCON's: one discount.
    "ppo.gamma": 0.99,
    "ppo.upper_gamma": 0.99,
    "runner.iterations": 20_000,
}
DISTILL = {
    **{f"env.{name}": value for name, value in ENV.items()},
    # Table II: K_ee 300 x U(0.5, 1.5), k_null 40 x U(0.6, 1.4), alpha U(0, 1).
    "env.upper_body.sampling.enabled": True,
    "env.upper_body.sampling.stiffness": (0.5 * 300.0, 1.5 * 300.0),
    "env.upper_body.sampling.log_uniform": False,
    "env.upper_body.sampling.null_stiffness": (0.6 * 40.0, 1.4 * 40.0),
    "env.upper_body.sampling.alpha": (0.0, 1.0),
    "env.upper_body.sampling.full_alpha": 0.0,
    "env.upper_body.singularity_ratio": True,
    "env.upper_body.left.name": "cotap",
    "env.upper_body.left.error": "joint",
    "env.upper_body.left.damping": "pd",
    "env.upper_body.left.condition_threshold": 10.0,
    "env.upper_body.right.name": "cotap",
    "env.upper_body.right.damping": "pd",
    "distillation.agents": ("lower",),
    "ppo.hidden": (512, 256, 128),
    "runner.iterations": 20_000,
}
TERMS = [
    ("torso_angular_velocity", 3, 0.25), ("projected_gravity", 3, 1.0), ("command_velocity", 2, 1.0),
    ("command_yaw_rate", 1, 1.0), ("command_stand", 1, 1.0), ("command_height", 1, 2.0),
    ("reference_arm_position", 8, 1.0), ("joint_position", 19, 1.0), ("joint_velocity", 19, 0.05),
    ("last_action", 19, 1.0), ("sin_phase", 1, 1.0), ("cos_phase", 1, 1.0), ("arm_torque", 8, 1.0),
]  # fmt: skip
"""Appendix B: what actors see of one step, widths on H1, scales."""
CRITIC_TERMS = [
    ("torso_orientation", 4, 1.0), ("torso_linear_velocity", 3, 2.0), ("hand_force", 6, 0.1)
]  # fmt: skip
"""What critics see beside that."""
UNITREE_KP = {
    "hip_yaw": 150.0, "hip_roll": 150.0, "hip_pitch": 150.0, "knee": 200.0, "ankle": 40.0, "torso": 300.0,
    "shoulder_pitch": 100.0, "shoulder_roll": 100.0, "shoulder_yaw": 100.0, "elbow": 100.0,
}  # fmt: skip
UNITREE_KD = dict.fromkeys(UNITREE_KP, 2.0) | {"knee": 4.0, "torso": 6.0}


def paper() -> tuple[BaseTraining, DistillTraining]:
    base = BASE_RECIPES["paper"]()
    return base, DISTILL_RECIPES["paper"](base)


@pytest.fixture(scope="module")
def env() -> HumanoidEnv:
    """The environment of the paper's second stage."""
    cfg = paper()[1].env
    cfg.num_envs, cfg.num_threads = 64, 1
    return HumanoidEnv(cfg)


@pytest.mark.parametrize(("name", "value"), BASE.items(), ids=BASE)
def test_the_base_has_the_papers_value(name: str, value: Any):
    assert attrgetter(name)(paper()[0]) == value


@pytest.mark.parametrize(("name", "value"), DISTILL.items(), ids=DISTILL)
def test_the_distillation_has_the_papers_value(name: str, value: Any):
    assert attrgetter(name)(paper()[1]) == value


def test_closeness_to_the_reference_is_rewarded_while_distilling():
    assert paper()[1].env.rewards.upper.reference_closeness > 0.0


def test_the_penalty_on_leaving_the_base_falls_to_zero_before_the_end():
    training = paper()[1]
    assert training.distillation.beta > 0.0
    assert training.distillation.end_samples < training.samples


def test_observations_are_those_of_the_papers_table(env: HumanoidEnv):
    layout = env.layout()
    assert [tuple(t) for t in layout["terms"]] == TERMS
    assert [tuple(t) for t in layout["critic_terms"]] == CRITIC_TERMS
    assert sum(width for _, width, _ in TERMS) == 86
    shapes = {name: value.shape[1] for name, value in env.get_observations().items()}
    assert shapes == {"policy": 5 * 86, "privileged": 13}
    assert env.obs_groups == {"actor": ["policy"], "critic": ["policy", "privileged"]}


def test_two_agents_share_the_joints(env: HumanoidEnv):
    assert env.reward_groups == ("lower", "upper")
    assert env.action_slices == {"lower": slice(0, 11), "upper": slice(11, 19)}


def test_gains_are_unitrees(env: HumanoidEnv):
    for joint in env.spec.joints:
        part = joint.name.removeprefix("left_").removeprefix("right_")
        assert (joint.kp, joint.kd) == (UNITREE_KP[part], UNITREE_KD[part]), joint.name


def test_what_is_drawn_lies_in_the_papers_ranges(env: HumanoidEnv):
    p, sim = env.upper_body.parameters, env.sim
    links = [sim.model.body(b.name).id for b in env.spec.bodies if b.name != env.spec.torso_body]
    torso = sim.model.body(env.spec.torso_body).id
    mass = sim.field("body_mass")
    scale = mass[:, links] / mass.new_tensor(sim.model.body_mass[links])
    nominal = float(sim.model.body_mass[torso])
    for drawn, low, high in (
        (p.stiffness, 150.0, 450.0), (p.null_stiffness, 24.0, 56.0), (p.alpha, 0.0, 1.0),
        (env.actuation.delay_s, 0.0, 0.02), (env.randomizer.kp_scale, 0.9, 1.1), (env.randomizer.kd_scale, 0.9, 1.1),
        (scale, 0.9, 1.2), (mass[:, torso], 0.9 * nominal - 1.0, 1.2 * nominal + 3.0),
    ):  # fmt: skip
        assert low - 1e-5 <= float(drawn.min()) < low + 0.2 * (high - low)
        assert high - 0.2 * (high - low) < float(drawn.max()) <= high + 1e-5
    median = float(p.stiffness.median())
    assert 280.0 < median < 320.0  # of the logarithm's uniform it would be 260


def every() -> dict[str, Any]:
    """Every recipe of either stage, distillations from every base."""
    out: dict[str, Any] = {}
    for base, make in BASE_RECIPES.items():
        out[base] = make()
        out |= {f"{base}, {name}": distil(make()) for name, distil in DISTILL_RECIPES.items()}
    return out | {f"{base}, g1": make("g1") for base, make in BASE_RECIPES.items()}


@pytest.mark.parametrize("name", every())
def test_every_recipe_is_valid_and_survives_json(name: str):
    training = every()[name]
    training.check()
    assert from_plain(type(training), json.loads(json.dumps(to_plain(training), allow_nan=False))) == training


@pytest.mark.parametrize("name", [*BASE_RECIPES, *(f"default, {name}" for name in DISTILL_RECIPES)])
def test_every_recipe_makes_an_environment(name: str):
    cfg = every()[name].env
    cfg.num_envs, cfg.num_threads = 2, 1
    env = HumanoidEnv(cfg)
    env.step(torch.zeros(2, env.num_actions))


@pytest.mark.parametrize("name", DISTILL_RECIPES)
def test_distilling_leaves_the_bases_config_as_it_was(name: str):
    base = BASE_RECIPES["default"]()
    training = DISTILL_RECIPES[name](base)
    training.env.rewards.upper.track_hands_as_facet = 9.0
    training.env.upper_body.left.alpha = 0.1
    training.env.forces.hand_loads.enabled = False
    training.ppo.hidden = (1,)
    assert base == BASE_RECIPES["default"]()


def test_a_distillation_begins_with_what_its_base_ended_with():
    training = DISTILL_RECIPES["default"](BASE_RECIPES["default"]())
    env = training.env
    assert not env.assist.enabled
    assert env.forces.pushes.enabled
    assert env.forces.pushes.ramp.share(0.0) == env.forces.hand_loads.ramp.share(0.0) == 1.0
    assert env.curriculum.arm_motion_samples == 0.0
    assert (training.ppo.initial_std, training.ppo.std_half_life) == (0.3, 75e6)


def test_a_distillation_has_what_the_punch_tour_has():
    """Pushes on any link, in any direction, of more than 40 N s on G1; a place that is held."""
    base = BASE_RECIPES["default"]()
    base.env.robot = "g1"
    env = DISTILL_RECIPES["default"](base).env
    pushes = env.forces.pushes
    assert pushes.velocity[1] * ROBOTS["g1"]().mass_kg > 45.0
    assert pushes.largest_pitch == pytest.approx(math.pi / 2)
    assert pushes.link_share > 0.0
    assert env.path.share > 0.0


def test_what_begins_anew_explores_as_widely_as_the_first_run_did():
    base = BASE_RECIPES["default"]()
    first = DISTILL_RECIPES["default"](base)
    second = DISTILL_RECIPES["default"](first)
    assert first.distillation.new_std == second.distillation.new_std == base.ppo.initial_std
    assert first.ppo.initial_std == second.ppo.initial_std == 0.5 * base.ppo.initial_std
    assert DISTILL_RECIPES["modulated"](first).distillation.new_std == 1.0


def test_facets_reward_is_that_of_both_stages():
    weights = DISTILL_RECIPES["facet"](BASE_RECIPES["facet"]()).env.rewards.upper
    assert (weights.track_hands_as_facet, weights.track_key_points) == (1.3, 0.0)


@pytest.mark.parametrize("num_envs", [512, 1024])
@pytest.mark.parametrize(
    ("names", "samples"),
    [
        (["default"], 75e6),
        (["quick", "no-ratio", "torque-critic", "goals", "facet"], 15e6),
        (["paper"], 20_000 * 24 * 4096),
    ],
)
def test_recipes_ask_for_as_many_samples_whatever_the_number_of_envs(names: list[str], samples: float, num_envs: int):
    base = BASE_RECIPES["default"]()
    base.env.num_envs = num_envs
    for name in names:
        training = DISTILL_RECIPES[name](base)
        asked = training.runner.iterations * training.ppo.steps * training.env.num_envs
        assert asked == pytest.approx(samples, rel=2e-3)


@pytest.mark.parametrize("name", ["default", "quick", "no-ratio", "facet", "modulated"])
def test_schedules_of_a_distillation_belong_to_its_samples(name: str):
    """Updates shrink to a quarter, as over a base, exploration to a half; the base guides for an eighth."""
    base = BASE_RECIPES["default"]()
    for training in (base, DISTILL_RECIPES[name](base)):
        assert training.samples / training.ppo.kl_half_life == pytest.approx(2.0, rel=7e-3)
        assert training.ppo.desired_kl == 0.01
    training = DISTILL_RECIPES[name](base)
    assert training.samples / training.ppo.std_half_life == pytest.approx(1.0, rel=7e-3)
    assert training.samples / training.distillation.end_samples == pytest.approx(8.0, rel=7e-3)


@pytest.mark.parametrize("make", BASE_RECIPES.values(), ids=BASE_RECIPES)
def test_training_ends_where_evaluations_see_a_fall(make: Any):
    assert make().env.terminations == TerminationConfig()


def test_the_papers_updates_do_not_shrink_and_its_exploration_is_learned():
    base = BASE_RECIPES["paper"]()
    assert DISTILL_RECIPES["paper"](base).ppo.std_half_life == base.ppo.std_half_life == 0.0
    assert DISTILL_RECIPES["paper"](base).ppo.kl_half_life == base.ppo.kl_half_life == 1e12


def test_facet_is_trained_on_unmoved_references_and_otherwise_as_cotap():
    """Appendix D: its own reward in the place of key points; no law moves the reference in training."""
    base = BASE_RECIPES["default"]()
    base.env.rewards.upper.track_arms = 2.0
    facet, cotap = (DISTILL_RECIPES[name](base) for name in ("facet", "no-ratio"))
    assert facet.env.upper_body.left.name == facet.env.upper_body.right.name == "pd"
    weights = cotap.env.rewards.upper
    changed = {"track_key_points": 0.0, "track_key_velocities": 0.0, "track_hands_as_facet": 1.3}
    changed["reference_closeness"] = 0.0
    assert to_plain(facet.env.rewards.upper) == to_plain(weights) | changed
    assert weights.track_arms == 2.0
    assert weights.reference_closeness == 1.0


@pytest.mark.parametrize(
    ("base", "name", "anew"),
    [
        ("default", "default", ("upper",)), ("default", "no-ratio", ("upper",)), ("default", "facet", ()),
        ("default", "paper", ()), ("default", "modulated", ()), ("paper", "default", ()),
    ],
)  # fmt: skip
def test_arms_begin_at_their_reference_where_a_zero_action_asks_for_it(base: str, name: str, anew: tuple[str, ...]):
    assert DISTILL_RECIPES[name](BASE_RECIPES[base]()).distillation.anew == anew


def test_a_modulated_policy_begins_in_the_middle_and_is_paid_for_the_task():
    """60 M samples, through an energy store; what does not give way to a push, or draws what the policy sets, is
    off."""
    training = DISTILL_RECIPES["modulated"](BASE_RECIPES["default"]())
    env, ppo = training.env, training.ppo
    assert training.runner.iterations * ppo.steps * env.num_envs == pytest.approx(60e6, rel=1e-3)
    laws = env.upper_body
    assert (laws.modulation.kind, laws.left.alpha, laws.right.alpha) == ("stiffness", 0.75, 0.75)
    assert laws.left.passive
    assert laws.right.passive
    assert not laws.sampling.enabled
    weights = env.rewards.upper
    assert max(weights.free_hand_error, weights.loaded_hand_error, weights.push_resistance) < 0.0
    assert weights.track_arms == weights.track_key_points == 0.0
    assert env.forces.hand_loads.enabled
    assert env.forces.pushes.enabled
