"""The task of learned modulation: its parts by hand, who sets the laws, and the report that compares settings."""

from __future__ import annotations

import json
import math

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
from cotap.evaluation.rollout import reference_actions
from cotap.evaluation.task import step_figures, task_measures
from reports.modulation_grid import Options
from reports.modulation_grid import main as grid


@pytest.fixture(scope="module")
def modulated(tmp_path_factory):
    """A policy with random weights that sets alpha and stiffness."""
    law = LawConfig("cotap", alpha=0.5)
    laws = UpperBodyConfig(law, law, modulation=ModulationConfig("stiffness"))
    return tmp_path_factory.mktemp("modulated") / "p.pt", HumanoidEnvConfig(num_envs=1, num_threads=1, upper_body=laws)


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


def test_the_raw_reference_comes_with_the_configured_laws(make_env):
    laws = LawOptions(method="cotap", alpha=0.3).configure()
    laws.modulation = ModulationConfig("alpha")
    env = make_env(2, upper_body=laws)
    assert reference_actions(env).shape == (2, len(env.spec.upper_joints) + 2)
    assert not reference_actions(env)[:, -2:].any()


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


@pytest.mark.slow
def test_the_grid_compares_with_its_best(checkpoint_of, tmp_path, capsys):
    args = ["--checkpoint", str(checkpoint_of), "--alphas", "0", "1", "--stiffnesses", "100", "900", "--num-envs", "4"]
    assert grid([*args, "--episode-seconds", "0.4", "--output", str(tmp_path)]) == 0
    result = json.loads((tmp_path / "modulation_grid.json").read_text())
    assert [(r["alpha"], r["stiffness"]) for r in result["grid"]] == [(0.0, 100.0), (1.0, 100.0), (1.0, 900.0)]
    best = max(result["grid"], key=lambda r: r["metrics"]["return"]["mean"])
    assert (result["best"]["alpha"], result["best"]["stiffness"]) == (best["alpha"], best["stiffness"])
    gained = result["learned_less_best"]["return"]["difference"]
    means = (result[name]["metrics"]["return"]["mean"] for name in ("learned", "best"))
    learned, constant = means
    assert gained == pytest.approx(learned - constant)
    assert "set by the policy" in capsys.readouterr().out
    with pytest.raises(ValueError, match=r"alphas\[0\]"):
        Options("p.pt", alphas=(2.0,)).check()
