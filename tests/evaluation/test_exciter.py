"""Who draws energy from hands: exciters by hand, their search, and what they get from laws that are known."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
import torch

from cotap.compliance.interface import LawReport
from cotap.compliance.laws import LAWS, PDLaw
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.evaluate import main
from cotap.evaluation.exciter import COMMANDS, GENES, Exciters, Limits, best_of, next_generation
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.passivity import Passivity, Tally
from cotap.evaluation.rollout import idle

LIMITS = Limits(force=20.0, brake=40.0, stiffness=(100.0, 400.0), seconds=4.0)


def exciters(command: str, count: int = 1, **genes: float) -> Exciters:
    """All genes zero but these, by their place."""
    values = torch.zeros(count, GENES)
    values[:, 1] = 1.0  # along y
    for name, value in genes.items():
        values[:, int(name.removeprefix("gene_"))] = value
    return Exciters(values, torch.full((count,), COMMANDS.index(command)), torch.full((count,), 8.0), LIMITS, 0)


def test_a_hand_is_pulled_and_braked_in_turns_and_braked_at_last():
    exciter = exciters("constant", gene_4=0.6)
    rate = 8.0 * 2.0 ** (2.5 * math.tanh(0.6) - 1.5)
    velocity = torch.tensor([[0.3, 0.0, -0.1]])
    pull, brake = [[0.0, 10.0, 0.0]], [[-6.0, 0.0, 2.0]]
    for time, expected in ((0.25 * math.pi / rate, pull), (1.5 * math.pi / rate, brake), (2.1 * math.pi / rate, pull)):
        assert time < 2.0
        torch.testing.assert_close(exciter.force(time, velocity), torch.tensor(expected))
    late = 2.0 + (0.5 * math.pi - 2.0 * rate) % (2.0 * math.pi) / rate  # sine is 1, but half of the time is over
    torch.testing.assert_close(exciter.force(late, velocity), torch.tensor(brake))
    assert float(exciters("constant", gene_3=50.0).force(0.1, velocity)[0, 1]) == 20.0


def test_stiffness_is_commanded_within_its_range_and_as_its_name_says():
    still = torch.zeros(1, 3)
    times = [0.02 * i for i in range(150)]

    def sequence(command, offset=still, velocity=still, **genes):
        exciter = exciters(command, **genes)
        return torch.tensor([float(exciter.stiffness(t, offset, velocity)) for t in times])

    assert sequence("constant").tolist() == pytest.approx([200.0] * 150)
    sine = sequence("sine", gene_10=50.0)
    assert sine.tolist() == pytest.approx([200.0 * 2.0 ** math.sin(8.0 * t) for t in times], rel=1e-4)
    assert sequence("steps")[1:].unique().tolist() == pytest.approx([100.0, 400.0], rel=1e-4)
    fast = sequence("steps", gene_8=50.0)  # twice the natural frequency
    assert int((fast.diff().abs() > 1.0).sum()) == pytest.approx(3.0 * 16.0 / math.pi, abs=1.0)
    drawn = sequence("random")
    assert 100.0 <= float(drawn.min()) < float(drawn.max()) <= 400.0
    assert len(drawn.unique()) == math.floor(8.0 * times[-1] / math.pi) + 1
    out, back = torch.tensor([[0.05, 0.0, 0.0]]), torch.tensor([[-0.1, 0.0, 0.0]])
    pulled, braked = (sequence("knowing", out, v)[[2, 140]] for v in (-back, back))
    assert pulled.tolist() == pytest.approx([100.0, 200.0], rel=1e-4)  # on the way out while pulled, soft
    assert braked.tolist() == pytest.approx([200.0, 400.0], rel=1e-4)  # on the way back while braked, stiff


def test_the_better_quarter_of_each_group_goes_on(rng):
    genes, group = torch.randn(16, GENES, generator=rng), torch.arange(16) % 2
    worth = torch.arange(16.0)
    worth[15], worth[0] = math.nan, math.inf
    new = next_generation(genes, worth, group, rng, 0.01)
    kept = (new == genes).all(1).nonzero().squeeze(1).tolist()
    assert kept == [0, 11, 13, 14]  # of the even ones 0 and 14, of the odd ones 11 and 13
    for i in range(16):
        distance = (new[i] - genes).norm(dim=1)
        nearest = int(distance.argmin())
        assert nearest in ((0, 14) if i % 2 == 0 else (11, 13))
        assert float(distance[nearest]) < 0.2
    best = best_of(genes, worth, group)
    assert torch.equal(best, genes[[0, 13]].repeat(8, 1))


def made(**fields) -> tuple[Passivity, HumanoidEnv]:
    protocol = Passivity(generations=1, settle_seconds=1.5, **fields)
    cfg = protocol.configure(HumanoidEnvConfig(num_threads=1))
    cfg.upper_body = LawOptions(method="cotap").configure()
    env = HumanoidEnv(cfg)
    protocol.prepare(env)
    return protocol, env


class Pushing:
    """PD whose damping has the wrong sign: gives energy away."""

    def __init__(self, arms) -> None:
        self._pd = PDLaw(replace(arms, kd=torch.full_like(arms.kd, -1.5)))

    def __call__(self, state, parameters):
        return self._pd(state, parameters)[0], LawReport()


def test_energy_is_drawn_from_what_is_active_and_none_from_pd(monkeypatch):
    monkeypatch.setitem(LAWS, "pushing", lambda arms, _: Pushing(arms))
    protocol, env = made(compared=("pd", "pushing"), num_envs=40, episode_seconds=1.0)
    result = protocol.evaluate(env, idle(env))
    for row in result["rows"]["pd"].values():
        assert row["largest"] < 1e-3
        assert row["lowest_store"] is None
    pushing = [row["drawn"]["mean"] for row in result["rows"]["pushing"].values()]
    assert min(pushing) > 0.05
    assert result["metrics"]["pushing, sine"] == result["rows"]["pushing"]["sine"]["drawn"]


@pytest.mark.slow
def test_a_store_bounds_what_an_exciter_that_knows_the_law_draws(rng):
    """With the PD law's weak damping, soft while it pulls and stiff while it brakes."""
    free, held = "cotap:damping=pd", "cotap:damping=pd,passive=true,store_energy=0.2"
    protocol, env = made(compared=(free, held), num_envs=80, episode_seconds=2.0, force_size=20.0)
    genes = 0.3 * torch.randn(80, GENES, generator=rng)
    genes[:, 4] = -0.5  # slow turns, and to the end
    genes[:, 7] = 3.0
    tally = protocol.excite(env, idle(env), genes, env.motions.default)
    knowing = protocol.group // 2 == COMMANDS.index("knowing")
    passive = protocol.group % 2 == 1
    loose, bound = tally.most[knowing & ~passive], tally.most[knowing & passive]
    assert float(loose.max()) > 0.5
    assert float(bound.max()) <= 0.2
    assert (tally.store[passive] >= 0.0).all()
    assert float(tally.store[knowing & passive].min()) < 0.05
    assert tally.store[~passive].isnan().all()
    assert not tally.fell.any()


def test_an_account_by_hand():
    """Three hands: 0.3 J in and 0.5 J out; as much in as out, then a fall; all that there is, diverging."""
    tally = Tally.empty(3, "cpu")
    tally.add(torch.tensor([0.3, 0.2, -0.1]), torch.tensor([False] * 3), torch.tensor([[0.5, 0.1]] * 3))
    tally.add(torch.tensor([-0.5, -0.2, 0.0]), torch.tensor([False] * 3), torch.tensor([[0.4, 0.1]] * 3))
    tally.add(torch.tensor([0.1, -9.0, math.nan]), torch.tensor([False, True, True]), torch.tensor([[0.6, 0.0]] * 3))
    fallen, diverged = tally.finished(diverged=False), tally.finished(diverged=True)
    assert fallen.most.tolist() == pytest.approx([0.2, 0.0, 0.1])
    assert diverged.most.tolist() == pytest.approx([0.2, math.inf, math.inf])
    assert fallen.drawn.tolist() == pytest.approx([0.1, 0.0, 0.1])
    assert fallen.store.tolist() == pytest.approx([0.4] * 3)
    assert fallen.worth.tolist() == pytest.approx([0.2, 0.0, 0.1])
    lossy = Tally.empty(1, "cpu")
    lossy.add(torch.tensor([0.4]), torch.tensor([False]), None)
    lossy.add(torch.tensor([-0.1]), torch.tensor([False]), None)
    assert lossy.worth.tolist() == pytest.approx([-0.75])


def test_the_command_prints_writes_and_draws(checkpoint, tmp_path, capsys):
    out = tmp_path / "p.json"
    arguments = ["--compared", "cotap", "cotap:passive=true", "--pelvis", "free", "--mode", "walking",
                 "--num-envs", "40", "--generations", "1", "--episode-seconds", "0.2", "--settle-seconds", "0.1",
                 "--threads", "1", "--json", str(out), "--plot", str(tmp_path / "p.png")]  # fmt: skip
    assert main(["passivity", "--checkpoint", str(checkpoint), *arguments]) == 0
    content = json.loads(out.read_text())
    assert set(content["rows"]) == {"cotap", "cotap:passive=true"}
    assert set(content["rows"]["cotap"]) == set(COMMANDS)
    assert content["rows"]["cotap:passive=true"]["knowing"]["lowest_store"] > 0.0
    assert (tmp_path / "p.png").stat().st_size > 5000
    shown = capsys.readouterr().out
    assert "| cotap:passive=true |" in shown
    assert "walking" in shown


@pytest.mark.parametrize(
    ("options", "message"),
    [(["--compared", "pid"], "--compared 'pid' is unknown"), (["--num-envs", "100"], "num_envs must be at least 160"),
     (["--compared", "pd:passive=true"], "--compared: pd does not read passive"),
     (["--generations", "0"], "generations"), (["--force-size", "0"], "force_size"), (["--brake", "0"], "brake"),
     (["--stiffness-range", "500", "100"], "stiffness_range[1]"), (["--mode", "walking"], "while the pelvis is fixed"),
     (["--method", "facet"], "--method does nothing here: the protocol sets it, see --compared"),
     (["--passive"], "--passive does nothing here"), (["--stiffness", "100"], "see --stiffness-range"),
     (["--left", "cotap:alpha=0.5"], "puts both arms under one law")],
)  # fmt: skip
def test_bad_options_are_named(options, message, capsys, shipped):  # noqa: ARG001
    assert main(["passivity", *options]) == 2
    assert message in capsys.readouterr().err
