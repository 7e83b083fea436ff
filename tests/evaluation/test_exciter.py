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
from cotap.evaluation.exciter import COMMANDS, GENES, Exciters, Limits, next_generation
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.passivity import Passivity, Tally
from cotap.evaluation.rollout import idle

LIMITS = Limits(force=20.0, brake=40.0, stiffness=(100.0, 400.0), seconds=4.0)


def exciters(command: str, count: int = 1, **genes: float) -> Exciters:
    """Along y with half of the force, for half of the time, and all genes zero but these, by their place."""
    values = torch.zeros(count, GENES)
    values[:, 1], values[:, 3], values[:, 7] = 1.0, -1.0, -2.0
    for name, value in genes.items():
        values[:, int(name.removeprefix("gene_"))] = value
    return Exciters(values, torch.full((count,), COMMANDS.index(command)), torch.full((count,), 8.0), LIMITS, 0)


def test_a_hand_is_pulled_and_braked_in_turns_and_braked_at_last():
    exciter = exciters("constant", gene_4=0.6)
    share = 1.0 / (1.0 + math.exp(-0.6))
    rate = (0.25 * math.pi) ** (1.0 - share) * 16.0**share  # between half a turn in 4 s and twice the natural frequency
    velocity = torch.tensor([[0.3, 0.0, -0.1]])
    pull, brake = [[0.0, 10.0, 0.0]], [[-6.0, 0.0, 2.0]]
    for time, expected in ((0.25 * math.pi / rate, pull), (1.5 * math.pi / rate, brake), (2.1 * math.pi / rate, pull)):
        assert time < 2.0
        torch.testing.assert_close(exciter.force(time, velocity), torch.tensor(expected))
    late = 2.0 + (0.5 * math.pi - 2.0 * rate) % (2.0 * math.pi) / rate  # sine is 1, but half of the time is over
    torch.testing.assert_close(exciter.force(late, velocity), torch.tensor(brake))
    assert float(exciters("constant", gene_3=50.0).force(0.1, velocity)[0, 1]) == 20.0


def test_a_pull_leads_around_a_circle_of_its_own_size_and_speed():
    """Along y and across in z, with half of the 20 N; 25 % of it the circle; slow, so that one pull lasts all along."""
    exciter = exciters("constant", gene_4=-50.0, gene_7=50.0, gene_16=3.0, gene_17=2.0, gene_18=1.25, gene_19=0.7)
    share = 1.0 / (1.0 + math.exp(-0.7))
    spin = 2.0 * (0.25 * math.pi) ** (1.0 - share) * 16.0**share
    force = torch.stack([exciter.force(0.02 * i, torch.zeros(1, 3))[0] for i in range(1, 200)])
    angle = spin * 0.02 * torch.arange(1.0, 200.0)
    expected = torch.stack((0.0 * angle, 7.5 - 2.5 * angle.cos(), 2.5 * angle.sin()), 1)
    torch.testing.assert_close(force, expected, atol=1e-3, rtol=0)
    through_zero = exciters("constant", gene_4=-50.0, gene_7=50.0, gene_17=1.0, gene_18=1.5, gene_19=-50.0)
    sizes = [float(through_zero.force(t, torch.zeros(1, 3)).norm()) for t in (1e-6, 2.0, 4.0 - 1e-6)]
    assert sizes == pytest.approx([0.0, 10.0, 0.0], abs=1e-4)  # once around in the whole time
    wild = Exciters(
        torch.randn(500, GENES, generator=torch.Generator().manual_seed(0)), torch.zeros(500, dtype=torch.long),
        torch.full((500,), 8.0), LIMITS, 0,
    )  # fmt: skip
    assert max(float(wild.force(0.1 * i, torch.zeros(500, 3)).norm(dim=1).max()) for i in range(40)) <= 20.0 + 1e-4


def test_stiffness_is_commanded_within_its_range_and_as_its_name_says():
    still = torch.zeros(1, 3)
    times = [0.02 * i for i in range(150)]

    def sequence(command, offset=still, velocity=still, **genes):
        exciter = exciters(command, **genes)
        rows = torch.cat([exciter.command(t, offset, velocity)[0] for t in times])
        assert torch.equal(rows, rows[:, :1].expand(-1, 3))
        return rows[:, 0]

    assert sequence("constant").tolist() == pytest.approx([200.0] * 150)
    sine = sequence("sine")
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


def test_each_axis_and_alpha_swing_by_their_own_depth():
    """Steps whose first half is stiff: x as it is, y half as far, z the other way; alpha falls with what is stiff."""
    at = (torch.zeros(1, 3), torch.zeros(1, 3))
    exciter = exciters("steps", gene_11=-1.25, gene_12=-2.0, gene_20=1.3)
    first, second = exciter.command(0.1, *at), exciter.command(0.5, *at)
    torch.testing.assert_close(first[0], 200.0 * torch.tensor([[2.0, 2.0**0.5, 0.5]]))
    torch.testing.assert_close(second[0], 200.0 * torch.tensor([[0.5, 2.0**-0.5, 2.0]]))
    assert [float(first[1]), float(second[1])] == pytest.approx([0.7, 1.0])
    other_way = exciters("steps", gene_20=-5.0)
    assert [float(other_way.command(t, *at)[1]) for t in (0.1, 0.5)] == pytest.approx([1.0, 0.0])
    assert float(exciters("constant", gene_20=2.0).command(0.1, *at)[1]) == 1.0


def test_the_search_stays_near_the_best_of_each_group_and_as_wide_as_they_are_apart(rng):
    """Of 2 groups of 2000, 1000 apart. The best quarter agrees on gene 0, and differs by 3 at gene 1."""
    group = torch.arange(4000) % 2
    genes, worth = torch.randn(4000, GENES, generator=rng), torch.rand(4000, generator=rng)
    genes[:, 2] += 1000.0 * group
    good = torch.arange(4000) >= 3000
    worth[good] += 2.0
    genes[good, 0], genes[good, 1] = 0.7, 20.0 + 3.0 * genes[good, 1]
    genes[:2, 1], worth[0], worth[1] = 1e6, math.nan, -math.inf
    new = next_generation(genes, worth, group, rng)
    assert torch.equal(new[:, 2] > 500.0, group == 1)
    assert float(new[:, 0].mean()) == pytest.approx(0.7, abs=0.02)
    assert float(new[:, 0].std()) == pytest.approx(0.15, rel=0.05)
    assert float(new[:, 1].mean()) == pytest.approx(20.0, abs=0.3)
    assert float(new[:, 1].std()) == pytest.approx(3.0 * math.hypot(1.0, 1.3), rel=0.05)
    worth[3999] = math.inf  # what makes the simulation diverge is best
    few = next_generation(genes[3996:], worth[3996:], 0 * group[3996:], rng)
    assert few.shape == (4, GENES)
    alone = next_generation(genes[:1], worth[:1], group[:1], rng)
    assert 0.0 < float((alone - genes[:1]).abs().max()) < 1.0


def tally_of_a_field(genes: torch.Tensor) -> Tally:
    """What exciters get within 4 s from a hand of 1 kg, 300 N/m and 10 Ns/m that is pushed with 100 N/m at a right
    angle to its offset as well, in the plane of x and y: no spring with an energy does so."""
    n, h = len(genes), 0.01
    exciter = Exciters(genes, torch.zeros(n, dtype=torch.long), torch.full((n,), 300.0**0.5), LIMITS, 0)
    field = torch.diag(torch.full((3,), -300.0))
    field[0, 1], field[1, 0] = -100.0, 100.0
    x, v, tally, force = torch.zeros(n, 3), torch.zeros(n, 3), Tally.empty(n, "cpu"), torch.zeros(n, 3)
    for step in range(400):
        if step % 2 == 0:
            force = exciter.force(step * h, v)
        v = v + h * (x @ field.T - 10.0 * v + force)
        x = x + h * v
        tally.add(h * (force * v).sum(1), torch.zeros(n, dtype=torch.bool), None)
    return tally


def test_only_a_circling_pull_draws_from_a_field_that_has_no_energy():
    """Along x and across; there and back; the other way round."""
    genes = torch.zeros(3, GENES)
    genes[:, 0], genes[:, 16], genes[:, 18] = 1.0, torch.tensor([-1.0, -1.0, 1.0]), torch.tensor([2.0, 1.0, 2.0])
    genes[:, 3], genes[:, 4], genes[:, 7], genes[:, 19] = 3.0, -50.0, 50.0, -1.0
    circling, straight, backwards = tally_of_a_field(genes).most.tolist()
    assert circling > 0.3
    assert straight == backwards == 0.0


def test_the_search_finds_the_circle():
    rng, group = torch.Generator().manual_seed(0), torch.arange(3).repeat_interleave(64)
    best = torch.randn(len(group), GENES, generator=rng)
    tally = tally_of_a_field(best)
    first = tally.most.clone()
    for _ in range(8):
        genes = next_generation(best, tally.worth, group, rng)
        tried = tally_of_a_field(genes)
        best, tally = torch.where((tried.worth > tally.worth).unsqueeze(1), genes, best), tally.or_better(tried)
    assert (tally.most >= first).all()
    for mine in tally.most.split(64):
        assert float(mine.max()) > float(first.max()) + 0.05
    assert float(best[tally.most.argmax(), 18]) > 1.3


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


def test_every_exciter_begins_where_hands_have_come_to_rest(rng):
    """Settled once; whatever was done since, the same exciter gets the same to the bit."""
    protocol, env = made(compared=("cotap:passive=true", "facet"), num_envs=40, episode_seconds=0.4)
    protocol.settle_seconds = 0.2
    act, (one, other) = idle(env), torch.randn(2, 40, GENES, generator=rng)
    poses = env.motions.default + 0.1 * torch.randn(40, 8, generator=rng)
    settled = protocol.settle(env, act, poses)
    first, _, again = (protocol.excite(env, act, genes, settled) for genes in (one, other, one))
    for name in ("drawn", "most", "taken", "given"):
        assert torch.equal(getattr(first, name), getattr(again, name))
    assert float(first.given.mean()) > 0.01
    p = env.upper_body.parameters
    assert float(p.stiffness.std(2).max()) > 1.0  # axes differ
    assert 0.0 <= float(p.alpha.min()) < 1.0
    constant = protocol.group // 2 == COMMANDS.index("constant")
    assert float(p.alpha[constant].min()) == 1.0
    torch.testing.assert_close(p.stiffness[constant], torch.full_like(p.stiffness[constant], (80.0 * 1200.0) ** 0.5))


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
    settled = protocol.settle(env, idle(env), env.motions.default)
    tally = protocol.excite(env, idle(env), genes, settled)
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
    other = Tally.empty(3, "cpu")
    other.add(torch.tensor([-0.1, -0.4, 0.0]), torch.tensor([True, False, False]), torch.tensor([[0.3], [0.9], [0.2]]))
    best = fallen.or_better(other)
    assert best.most.tolist() == pytest.approx([0.2, 0.4, 0.1])
    assert best.taken.tolist() == pytest.approx([0.5, 0.4, 0.1])
    assert best.fell.tolist() == [True, True, True]
    assert best.store.tolist() == pytest.approx([0.4, 0.4, 0.2])
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
