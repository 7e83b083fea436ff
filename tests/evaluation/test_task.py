"""The task of learned modulation: its parts by hand, who sets the laws, and the report that compares settings."""

from __future__ import annotations

import copy
import json
import math
from dataclasses import replace

import pytest
import torch

from cotap.compliance.laws import LawConfig
from cotap.configs import BASE_RECIPES, DISTILL_RECIPES
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.arm_task import TASK_WEIGHTS
from cotap.envs.modulation import ModulationConfig
from cotap.envs.upper_body import UpperBodyConfig
from cotap.evaluate import evaluate, main, parse, prepare
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.rollout import acting, idle
from cotap.evaluation.task import step_figures, task_measures
from reports.modulation_grid import Options, Trial, asked, hand_states
from reports.modulation_grid import main as grid

MODULATED = UpperBodyConfig(*[LawConfig("cotap", alpha=0.5)] * 2, modulation=ModulationConfig("stiffness"))


@pytest.fixture(scope="module")
def modulated(tmp_path_factory):
    """A policy with random weights that sets alpha and stiffness."""
    cfg = HumanoidEnvConfig(num_envs=1, num_threads=1, upper_body=MODULATED)
    return tmp_path_factory.mktemp("modulated") / "p.pt", cfg


@pytest.fixture
def checkpoint_of(modulated, save):
    path, cfg = modulated
    return path if path.is_file() else save(path, cfg)


def test_measures_by_hand():
    """Two steps of two envs, each with two hands; the second env fell in the second step."""
    w = TASK_WEIGHTS
    figures = torch.zeros(2, 8, 2)
    figures[:, 0], figures[:, 3] = torch.tensor([[0.01, 0.03], [0.02, 9.0]]), torch.tensor([[0.5, 1.0], [1.0, 9.0]])
    figures[:, 2], figures[:, 5] = torch.tensor([[6.0, 0.0], [0.0, 9.0]]), torch.tensor([[0.5, 0.0], [0.0, 9.0]])
    figures[:, 6], figures[:, 7] = torch.tensor([[0.2, 1.0], [0.4, 9.0]]), 300.0
    m = task_measures(figures, torch.tensor([[True, True], [True, False]]))
    assert m["return_free_hand_error"].tolist() == pytest.approx(
        [w["free_hand_error"] * 0.015, w["free_hand_error"] * 0.03]
    )
    assert m["return_push_resistance"].tolist() == pytest.approx([w["push_resistance"] * 3.0, 0.0])
    assert m["return"].tolist() == pytest.approx(
        [w["free_hand_error"] * 0.015 + w["push_resistance"] * 3.0, w["free_hand_error"] * 0.03]
    )
    assert m["free_hand_error"].tolist() == pytest.approx([0.02, 0.03])  # of the time that hands are free
    assert float(m["push_resistance"][0]) == pytest.approx(12.0)
    assert math.isnan(m["push_resistance"][1])
    assert m["loaded_hand_error"].isnan().all()
    assert m["alpha"].tolist() == pytest.approx([0.3, 1.0])


def test_a_step_is_worth_what_the_recipe_pays_for_it():
    """Figures times weights are what the upper agent gets for these terms, in all three states of hands."""
    cfg = DISTILL_RECIPES["modulated"](BASE_RECIPES["default"]()).env
    cfg.num_envs, cfg.num_threads, cfg.forces.pushes.interval_s = 16, 1, (1.0, 1.0)
    cfg.forces.pushes.duration_s = (1.0, 1.0)
    env = HumanoidEnv(cfg)
    paid, found, shares = torch.zeros(16), torch.zeros(16), torch.zeros(3)
    group = next(g for g in env._groups if g.name == "upper")
    rows = [list(group.terms).index(name) for name in TASK_WEIGHTS]
    for _ in range(60):
        env.step(torch.zeros(16, env.num_actions))
        figures = step_figures(env)
        paid += group(env.record)[1][rows].sum(0)
        found += env.dt * (torch.tensor(list(TASK_WEIGHTS.values()))[:, None] * figures[:3]).sum(0)
        shares += figures[3:6].mean(1) / 60
    torch.testing.assert_close(found, paid)
    assert float(shares.min()) > 0.02
    assert float(shares.sum()) < 1.0  # pushes on loaded hands count nowhere
    assert set(TASK_WEIGHTS) <= set(group.terms)


@pytest.mark.parametrize(
    ("protocol", "options", "held"),
    [
        ("task", [], False), ("task", ["--alpha", "0.5"], True), ("task", ["--stiffness", "500"], True),
        ("task", ["--left", "cotap:alpha=0.2"], True), ("task", ["--null-stiffness", "30"], False),
        ("task", ["--passive"], False), ("impact", [], False), ("modulation", [], True), ("fidelity", [], True),
        ("constant-load", ["--pelvis", "fixed"], True), ("constant-load", ["--method", "pd"], True),
    ],
)  # fmt: skip
def test_constant_settings_hold_what_the_policy_would_set(protocol, options, held, checkpoint_of):
    args = [protocol, "--checkpoint", str(checkpoint_of), "--num-envs", "2", *options]
    env, policy, _ = prepare(parse(args))
    assert env.upper_body.modulation.active != held
    env.step(policy(dict(env.get_observations().items())))


def test_the_raw_reference_comes_with_the_laws_that_the_policy_asks_for(make_env):
    laws = LawOptions(method="cotap", alpha=0.3).configure()
    laws.modulation = ModulationConfig("alpha")
    env = make_env(2, upper_body=laws)
    asked = torch.rand(2, env.num_actions)
    for share in (0.0, 0.25):
        actions = acting(env, lambda _: asked, str(share))({})
        assert torch.equal(actions[:, : env.num_lower], asked[:, : env.num_lower])
        torch.testing.assert_close(actions[:, env.num_lower : -2], share * asked[:, env.num_lower : -2])
        assert torch.equal(actions[:, -2:], asked[:, -2:])
    assert not idle(env)({}).any()


def test_its_alpha_is_what_was_asked_for(checkpoint_of, capsys):
    common = ["task", "--checkpoint", str(checkpoint_of), "--num-envs", "4", "--episode-seconds", "0.6"]
    found = [
        evaluate([*common, *more])["metrics"] for more in ([], ["--alpha", "0.9", "--stiffness", "200", "--per-env"])
    ]
    assert found[1]["alpha"]["mean"] == pytest.approx(0.9)
    assert found[1]["stiffness"]["mean"] == pytest.approx(200.0, rel=1e-4)
    assert found[0]["alpha"]["mean"] != pytest.approx(0.5, abs=1e-4)
    assert "| return |" in capsys.readouterr().out
    assert main(["task", "--episode-seconds", "0"]) == 2
    assert "episode_seconds" in capsys.readouterr().err


BY_STATE = ((1.0, 900.0, 900.0, 900.0), (0.5, 600.0, 600.0, 1200.0), (0.9, 80.0, 80.0, 80.0))
"""Alpha and stiffness of hands that are free, loaded and pushed."""


def test_an_oracle_asks_for_the_setting_of_each_hands_state(make_env):
    push, load, nothing = torch.tensor([10.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, -20.0]), torch.zeros(3)
    env = make_env(2)
    env.step(torch.zeros(2, env.num_actions))
    pushes = torch.stack((torch.stack((nothing, push)), torch.stack((push, nothing))))
    loads = torch.stack((torch.stack((nothing, nothing)), torch.stack((load, load))))
    env.record = replace(env.record, hand_force_w=pushes + loads, hand_push_w=pushes)
    state = hand_states(env)
    assert state.tolist() == [[0, 2], [1, 1]]  # a push on a loaded hand is no reason to drop the load
    wanted = asked(BY_STATE, state).unflatten(1, (2, 4))
    torch.testing.assert_close(wanted[..., 0], torch.tensor([[1.0, 0.9], [0.5, 0.5]]))
    torch.testing.assert_close(wanted[0, 1, 1:].exp(), torch.full((3,), 80.0))
    torch.testing.assert_close(wanted[1, 0, 1:].exp(), torch.tensor([600.0, 600.0, 1200.0]))


def test_an_oracle_is_as_slow_as_a_policy():
    """By hand: from alpha 0.5 and 300 N/m, 0.08 and a factor of e^0.2 a step, up to what is asked for."""
    trial = Trial(num_envs=2, by_state=BY_STATE, passive=True)
    cfg = trial.configure(HumanoidEnvConfig(num_threads=1, upper_body=copy.deepcopy(MODULATED)))
    cfg.forces.hand_loads.enabled = cfg.forces.pushes.enabled = False
    assert cfg.upper_body.left.passive
    assert cfg.upper_body.modulation.held
    env = HumanoidEnv(cfg)
    trial.prepare(env)
    alpha, stiffness = [], []
    for step in range(8):
        trial.before_step(env, step)
        env.step(torch.zeros(2, env.num_actions))
        alpha.append(float(env.upper_body.parameters.alpha[1, 0]))
        stiffness.append(float(env.upper_body.parameters.stiffness[1, 1, 2]))
    assert alpha == pytest.approx([min(0.5 + 0.08 * (k + 1), 1.0) for k in range(8)], abs=1e-6)
    assert stiffness == pytest.approx([min(300.0 * math.exp(0.2 * (k + 1)), 900.0) for k in range(8)], rel=1e-5)


def test_refined_settings_lie_around_the_best_and_within_the_grid():
    options = Options(stiffnesses=(80.0, 1200.0))
    found = options.refined((0.5, 300.0, 300.0, 600.0), 2.0)
    assert set(found) == {
        (0.5, 600.0, 300.0, 600.0), (0.5, 300.0, 600.0, 600.0), (0.5, 300.0, 300.0, 1200.0),
        (0.5, 600.0, 600.0, 600.0), (0.5, 150.0, 300.0, 600.0), (0.5, 300.0, 150.0, 600.0),
        (0.5, 300.0, 300.0, 300.0), (0.5, 150.0, 150.0, 600.0),
    }  # fmt: skip
    assert set(options.refined((1.0, 1200.0, 1200.0, 80.0), 100.0)) == {
        (1.0, 1200.0, 1200.0, 1200.0), (1.0, 80.0, 1200.0, 80.0), (1.0, 1200.0, 80.0, 80.0), (1.0, 80.0, 80.0, 80.0)
    }  # fmt: skip


@pytest.mark.parametrize(
    ("fields", "message"),
    [({"alphas": (2.0,)}, r"alphas\[0\]"), ({"stiffnesses": ()}, "number of stiffnesses"),
     ({"grid_envs": 0}, "grid_envs"), ({"episode_seconds": 0.0}, "episode_seconds")],
)  # fmt: skip
def test_bad_options_of_the_grid_are_named(fields, message):
    with pytest.raises(ValueError, match=message):
        Options(**fields).check()


@pytest.mark.slow
def test_the_grid_compares_with_its_best(checkpoint_of, tmp_path, capsys):
    args = ["--checkpoint", str(checkpoint_of), "--alphas", "0", "1", "--stiffnesses", "100", "900", "--num-envs", "4"]
    args += ["--grid-envs", "2", "--threads", "1"]
    assert grid([*args, "--episode-seconds", "0.4", "--output", str(tmp_path)]) == 0
    result = json.loads((tmp_path / "modulation_grid.json").read_text())
    settings = [tuple(row["setting"]) for row in result["grid"]]
    assert settings[:3] == [(0.0, 100.0, 100.0, 100.0), (1.0, 100.0, 100.0, 100.0), (1.0, 900.0, 900.0, 900.0)]
    assert len(set(settings)) == len(settings) > 6
    for measure, found in (("return", result["best"]), *((f"return_{k}", v) for k, v in result["by_state"].items())):
        assert found == max(result["grid"], key=lambda row: row["metrics"][measure]["mean"])["setting"], measure
    rows = result["compared"]
    assert [row["passive"] for row in rows] == [False] * 4 + [True] * 4
    constant, _, own_legs, learned = rows[:4]
    assert own_legs["less_constant"]["return"]["difference"] != 0.0  # they are another policy's
    assert not any(row["difference"] for row in constant["less_constant"].values())
    gained = learned["less_constant"]["return"]
    assert gained["pairs"] == 4
    assert gained["difference"] == pytest.approx(
        learned["metrics"]["return"]["mean"] - constant["metrics"]["return"]["mean"], abs=1e-5
    )
    shown = capsys.readouterr().out
    assert "set by the policy; no store" in shown
    assert "oracle: set by the hand's true state; store" in shown
