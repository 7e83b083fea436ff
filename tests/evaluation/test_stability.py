"""Linearised loops against MuJoCo's own inertia and gravity, laws that are known to be active, energy accounts."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from cotap.compliance.interface import LawParameters, LawReport
from cotap.compliance.laws import LAWS, LawConfig, PDLaw
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.upper_body import UpperBodyConfig
from cotap.evaluate import main
from cotap.evaluation.linearization import linearize
from cotap.evaluation.stability import Stability, energy_summary, exchanged_energy, growth_rates, random_poses
from cotap.robots.chains import arm_model

DT = 0.02


class Pushing:
    """PD whose damping has the wrong sign: gives energy away."""

    def __init__(self, arms, damping=-2.0) -> None:
        self._pd = PDLaw(replace(arms, kd=torch.full_like(arms.kd, damping)))

    def __call__(self, state, parameters):
        return self._pd(state, parameters)[0], LawReport()


def parameters(n, stiffness=500.0, alpha=1.0) -> LawParameters:
    return LawParameters(torch.full((n, 2, 3), stiffness), torch.full((n, 2), 25.0), torch.full((n, 2), alpha))


def loop(spec, name, q, stiffness=500.0, **fields):
    cfg = LawConfig(name, **fields)
    return linearize(lambda a: LAWS[name](a, cfg), arm_model(spec), q, q, parameters(len(q), stiffness), DT)


@pytest.mark.parametrize("kp", [100.0, 30.0])
def test_pd_has_the_eigenvalues_of_mujocos_arm(spec, model, rng, kp):
    """`M q'' + D q' + (K + dg/dq) q = 0`, M, g and the joints' friction from MuJoCo."""
    q = random_poses(spec, 4, rng)
    found = loop(spec, "soft-pd", q, soft_gain=kp).growth().reshape(4, 2)
    arm = slice(17, 21)
    for env in range(4):
        data, dense = mujoco.MjData(model), np.zeros((model.nv, model.nv))
        bias = []
        for joint in (None, 0, 1, 2, 3):
            data.qpos[:] = 0.0
            data.qpos[3] = 1.0
            data.qpos[18:22] = q[env, 0]
            if joint is not None:
                data.qpos[18 + joint] += 1e-5
            mujoco.mj_forward(model, data)
            bias.append(data.qfrc_bias[arm].copy())
            if joint is None:
                mujoco.mj_fullM(model, data, dense)
        gravity = np.stack([(b - bias[0]) / 1e-5 for b in bias[1:]], 1)
        inverse, friction = np.linalg.inv(dense[arm, arm]), 2.0 * np.eye(4) + np.diag(model.dof_damping[arm])
        flow = np.block([[np.zeros((4, 4)), np.eye(4)], [-inverse @ (kp * np.eye(4) + gravity), -inverse @ friction]])
        assert float(found[env, 0]) == pytest.approx(np.linalg.eigvals(flow).real.max(), rel=1e-3)


def test_what_is_known_of_laws(spec, rng):
    """The wrong damping grows; a FACET does against a stiff wall and not when free; CoTaP holds against any wall."""
    q = 0.5 * random_poses(spec, 20, rng)
    pushing = linearize(Pushing, arm_model(spec), q, q, parameters(20), DT)
    assert float(pushing.growth().min()) > 0.0
    facet, cotap = loop(spec, "facet", q), loop(spec, "cotap", q)
    assert float(facet.growth().max()) < 0.0
    assert float(facet.growth(1e4).min()) > 1.0
    for wall in (0.0, 100.0, 1e4):
        assert float(cotap.growth(wall).max()) < 0.0
    # An impedance without null-space stiffness leaves one direction to itself.
    assert float(loop(spec, "hmc", q).growth().max()) > -0.05


def test_a_free_facet_decays_with_the_slower_of_arm_and_virtual_mass(spec, rng):
    """A heavy, barely damped model: `zeta sqrt(K / m)`."""
    q = 0.3 * random_poses(spec, 3, rng)
    slow = loop(spec, "facet", q, stiffness=400.0, virtual_mass=4.0, damping_ratio=0.05)
    torch.testing.assert_close(slow.growth(), torch.full((6,), -0.5).double(), atol=1e-4, rtol=0)
    # A soft wall pulls back, and late: what pulls back late takes damping away (and pushing on late would add some).
    assert (slow.growth(50.0) > slow.growth() + 0.1).all()


def test_rates_are_counted_per_wall_and_load(spec):
    protocol = Stability(poses=10, walls=(0.0, 1e4), load_rad=0.1)
    rows = growth_rates(spec, LawConfig("facet", stiffness=(500.0, 500.0, 500.0)), protocol, DT)
    assert [(r["load_rad"], r["wall"]) for r in rows] == [(0.0, 0.0), (0.0, 1e4), (0.1, 0.0), (0.1, 1e4)]
    law = LawConfig("facet", stiffness=(500.0, 500.0, 500.0))
    assert growth_rates(spec, law, protocol, DT / 10.0) != rows  # acting more often makes another loop
    assert rows[0]["share_unstable"] == 0.0
    assert rows[1]["share_unstable"] == 1.0


def drawn(name: str) -> dict:
    protocol = Stability(num_envs=6, episode_seconds=1.5, settle_seconds=4.0, frequency=(1.0, 4.0))
    cfg = protocol.configure(HumanoidEnvConfig(num_threads=1))
    cfg.upper_body = UpperBodyConfig(LawConfig(name), LawConfig(name))
    return energy_summary(exchanged_energy(HumanoidEnv(cfg), protocol)[0])


def test_energy_is_drawn_from_what_is_active_and_from_nothing_else(monkeypatch):
    monkeypatch.setitem(LAWS, "pushing", lambda arms, _: Pushing(arms, -1.5))
    assert drawn("pushing")["constant_stiffness"]["share_drawn"] > 0.5
    for kind in drawn("soft-pd").values():
        assert kind["share_drawn"] == 0.0
        assert kind["least_energy"] > -1e-4  # however much one hand takes by the waist of what the other gives


def test_energy_accounts():
    """Two envs: lacks 0.5 J on the way and gains in the end; has diverged."""
    energy = torch.tensor([[0.0, 0.0], [-0.5, 0.1], [0.7, -math.inf]])
    summary = energy_summary(energy)
    assert summary["constant_stiffness"] == {
        "trials": 1, "mean_least_energy": -0.5, "least_energy": -0.5, "share_drawn": 1.0, "num_diverged": 0,
    }  # fmt: skip
    assert summary["changing_stiffness"]["num_diverged"] == 1
    assert summary["changing_stiffness"]["least_energy"] is None


def test_the_command_prints_and_writes(checkpoint, tmp_path, capsys):
    out = tmp_path / "stability.json"
    arguments = ["--method", "cotap+facet-matched", "--poses", "4", "--num-envs", "2", "--episode-seconds", "0.2",
                 "--settle-seconds", "0.2", "--threads", "1", "--json", str(out),
                 "--plot", str(tmp_path / "stability.png")]  # fmt: skip
    assert main(["stability", "--checkpoint", str(checkpoint), *arguments]) == 0
    content = json.loads(out.read_text())
    assert len(content["linearised"]) == 8
    assert content["energy"]["changing_stiffness"]["trials"] == 1
    assert (tmp_path / "stability.png").stat().st_size > 5000
    assert "largest real part" in capsys.readouterr().out


def test_without_the_ratio_both_halves_are_without_it(spec, checkpoint, tmp_path):
    """Poses beyond a condition number of 2 are most: the ratio and its absence make different loops."""
    law = "cotap:condition_threshold=2"
    arguments = ["--left", law, "--right", law, "--singularity-ratio", "False", "--poses", "8", "--num-envs",
                 "2", "--episode-seconds", "0.1", "--settle-seconds", "0.1", "--threads", "1", "--json"]  # fmt: skip
    assert main(["stability", "--checkpoint", str(checkpoint), *arguments, str(tmp_path / "out.json")]) == 0
    content = json.loads((tmp_path / "out.json").read_text())
    left = LawConfig("cotap", condition_threshold=2.0)
    never = replace(left, condition_threshold=math.inf)
    assert content["linearised"] == growth_rates(spec, never, Stability(poses=8), DT)
    assert content["linearised"] != growth_rates(spec, left, Stability(poses=8), DT)
    assert not content["settings"]["env"]["upper_body"]["singularity_ratio"]


@pytest.mark.parametrize(
    ("option", "message"),
    [("--poses=0", "poses"), ("--walls=-1", "walls[0]"), ("--num-envs=1", "num_envs"), ("--force-size=0", "force_size"),
     ("--change-factor=0.5", "change_factor"), ("--frequency", "frequency[1]")],
)  # fmt: skip
def test_bad_options_are_named(option, message, capsys):
    arguments = [option, "5", "1"] if option == "--frequency" else [option]
    assert main(["stability", *arguments]) == 2
    assert message in capsys.readouterr().err
