"""The page that reports.reproduce_paper writes: verdicts, marks, missing checkpoints, numbers as they were measured."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from random_policy import save_random_policy

from cotap.agents.checkpoint import load_checkpoint, save_checkpoint, sha256
from cotap.evaluate import pictures
from reports import reproduce_paper as rp
from reports.compare_laws import Static, Transient
from reports.paper import ablation, facet, fidelity, observation, relative, sim_to_sim, walking, words
from reports.paper.arms import COMPLIANT, PD, SOFT, arms, label
from reports.paper.book import Book
from reports.paper.tables import IMPACT, ORDERINGS
from reports.paper.trainings import Trainings


@pytest.fixture
def book(tmp_path: Path) -> Book:
    return Book("h1", tmp_path, tmp_path / "evaluations", envs=4, threads=1)


def measured(mean: float, half: float = 0.1, **others: float) -> dict[str, Any]:
    """A result with one mean for every measure, and others for some."""

    def summary(value: float) -> dict[str, Any]:
        return {"mean": value, "std": 1.0, "ci95": [value - half, value + half]}

    measures = {name: summary(mean) for name in (*words.LABELS, "e_upper", "e_torso_x", "e_torso_y")}
    measures |= {name: summary(value) for name, value in others.items()}
    return {"metrics_without_falls": measures, "settings": {"seed": 0}, "num_falls": 1, "num_envs": 8}


@pytest.mark.parametrize(
    ("larger", "verdict"),
    [(20.0, "holds"), (5.0, "does not hold"), (10.1, "cannot be distinguished"), (None, "not measured")],
)
def test_an_ordering_gets_the_verdict_that_its_interval_allows(book, larger, verdict):
    book.results["small"] = measured(10.0)
    if larger is not None:
        book.results["large"] = measured(larger)
    assert verdict in words.verdict(book, "small", "large", "j_upper")


def test_better_than_pd_is_better_in_all_three(book):
    book.results["pd"] = measured(1.0)
    book.results["all"] = measured(0.5)
    book.results["two"] = measured(0.5, j_upper=1.5)
    book.results["same"] = measured(0.5, e_ee=1.05)
    assert words.better_in_all(book, "pd", "all") == "**yes**"
    assert words.better_in_all(book, "pd", "two") == "no: J_upper worse"
    assert words.better_in_all(book, "pd", "same") == "no: e_ee not distinguishable"
    assert words.better_in_all(book, "pd", "none") == "(not measured)"


def test_differences_are_those_of_the_rows(book):
    book.results |= {"a": measured(1.0), "b": measured(3.0)}
    assert words.change(book, "b", "a", "e_torso") == "-2.000±0.141"  # 0.1 x sqrt(2) to either side
    assert book.differences["e_torso: a - b"]["difference"] == -2.0


def test_numbers_are_shown_with_interval_or_reason():
    assert words.number({"mean": 0.12345, "ci95": [0.1, 0.2]}) == "0.123±0.077"
    assert words.number({"mean": None, "ci95": None, "reason": "no env stood"}) == "(no env stood)"
    assert words.number({"mean": 31.0, "ci95": None, "reason": "wide"}, 0) == "31 (wide)"
    assert words.number(None) == "(not measured)"
    assert words.hundredfold({"mean": 0.5, "ci95": [0.25, 0.75]}) == "50.0±25.0"
    assert words.share(7, 8) == "87.5 [52.9,97.8]"
    assert words.fallen({"num_falls": 1, "num_envs": 8}) == "12.5 [2.2,47.1]"


@pytest.mark.parametrize("robot", ["h1", "g1"])
def test_what_there_is_no_checkpoint_of_is_a_row_that_says_so(robot, tmp_path, monkeypatch):
    monkeypatch.setattr("cotap.evaluate.evaluate", lambda *_: pytest.fail("nothing may be measured"))
    book = Book(robot, tmp_path, tmp_path)
    for part in rp.PARTS.values():
        part(book)
    assert not book.results
    page = "\n".join(book.lines)
    assert sum("not measured" in line for line in book.lines) > 90
    assert "{" not in page
    assert re.search(r"\| K 100 \| no checkpoint of `cotap`: not measured \|[ |]*\| 0.861 / 0.101 / 46.664 \|", page)
    assert re.search(r"\| FACET \| no checkpoint of `facet`: not measured \|", page)
    assert "H1's 51 kg by 0.49 m/s" in page
    assert ("| paper (H1) |" in page) == ("| paper |" not in page) == ("whose robot is H1" in page) == (robot == "g1")
    assert ("### Impulse by mass" in page) == (robot == "g1")
    for table in re.findall(r"(?:^\|.*\n)+", page, re.M):
        assert len({line.count("|") for line in table.splitlines()}) == 1


def test_laws_are_scaled_to_the_robot():
    assert label("h1", PD) == "PD, kp 100"
    assert (label("h1", SOFT), label("g1", SOFT)) == ("soft PD, kp 30", "soft PD, kp 12")
    assert label("g1", PD) == "PD, kp 20 to 40"
    assert arms("g1")[SOFT] == ["--left", "soft-pd:soft_gain=12", "--right", "soft-pd:soft_gain=12"]


def test_every_ordering_is_one_that_the_paper_shows():
    column = {"e_torso": 0, "e_ee": 1, "j_upper": 2}
    for rows in IMPACT.values():
        assert set(rows) == {PD, SOFT, *COMPLIANT} <= set(arms("h1"))
        for measure, smaller, larger in ORDERINGS:
            assert rows[smaller][column[measure]] < rows[larger][column[measure]]


def test_three_trainings_give_students_interval():
    """Of 1, 2, 3: mean 2, deviation 1; t of two degrees of freedom is 4.3027, and 4.3027 sqrt(4 / 3) is 4.9683."""
    three = Trainings((1.0, 2.0, 3.0))
    assert three.interval == pytest.approx((-2.9683, 6.9683), abs=1e-4)
    assert three.text() == "2.000 (range 1.000 to 3.000; interval -2.968 to 6.968)"
    assert three.outside(7.0)
    assert three.outside(-3.0)
    assert not three.outside(6.9)
    one = Trainings((1.0,))
    assert one.text(1) == "1.0 (one training)"
    assert not one.outside(9.0)
    assert Trainings(()).text() == "(not measured)"


def test_an_ablation_outside_the_trainings_is_marked(book, monkeypatch):
    """Trainings of 1, 2 and 3 in every measure: a fourth would be below 6.9683."""
    values = {"seed-0": 1.0, "seed-1": 2.0, "seed-2": 3.0, "no-ratio": 8.0, "goals": 4.0, "cotap": 9.0}
    monkeypatch.setattr(Book, "has", lambda _, policy: policy in values)
    monkeypatch.setattr(Book, "checkpoint", lambda *_: {"samples": 15_000_000})
    run = {name: measured(value, e_upper=2.0) for name, value in values.items()}
    run["no-ratio"]["num_falls"] = 2
    monkeypatch.setattr(Book, "run", lambda _, __, policy, *___: run.get(policy))
    ablation.ablation(book)
    tables = "\n".join(book.lines).split("\n\n")
    rows, falls = (
        {line.split(" | ")[0][2:]: line.split(" | ")[1:4] for line in text.splitlines() if line.startswith("| ")}
        for text in tables
        if text.startswith("| what")
    )
    assert rows["without the ratio"] == ["15.0", "**8.000±0.100**", "2.000±0.100"]
    assert rows["goals observed"][1] == "4.000±0.100"
    assert rows["CoTaP, three seeds"][1] == "2.000 (range 1.000 to 3.000; interval -2.968 to 6.968)"
    assert rows["CoTaP"][1] == "9.000±0.100"  # another training, not marked
    assert falls["goals observed"] == ["12.5 [2.2,47.1]"] * 3  # as of each seed, of all 1 of 8
    assert falls["CoTaP, three seeds"][0] == "12.5 (range 12.5 to 12.5; interval 12.5 to 12.5)"
    assert falls["without the ratio"] == ["**25.0 [7.1,59.1]**"] * 3
    del values["seed-1"]
    book.lines.clear()
    ablation.ablation(book)
    assert any(line.startswith("| CoTaP, three seeds (2 there) |") for line in book.lines)


def test_the_relative_change_is_of_envs_that_stood_in_both():
    before = {"stood": [1.0, 1.0, 1.0, 1.0, 0.0], "e_ee": [1.0, 2.0, 3.0, None, 5.0]}
    after = {"stood": [1.0, 1.0, 1.0, 1.0, 1.0], "e_ee": [2.0, 4.0, 6.0, 1.0, 900.0]}
    change = relative.relative_change(before, after, "e_ee")
    assert change == {"mean": pytest.approx(1.0), "ci95": pytest.approx([1.0, 1.0]), "n": 3}
    fallen = relative.relative_change(before | {"stood": [0.0] * 5}, after, "e_ee")
    assert (fallen["mean"], fallen["n"]) == (None, 0)


def test_the_relative_change_has_a_bootstrap_interval():
    """100 envs at 1 before, half of them at 0.5 and half at 0.9 after: 0.7 of it, give or take 1.96 x 0.2 / 10."""
    before = {"stood": [1.0] * 100, "e_ee": [1.0] * 100}
    after = {"stood": [1.0] * 100, "e_ee": [0.5, 0.9] * 50}
    change = relative.relative_change(before, after, "e_ee")
    assert change["mean"] == pytest.approx(-0.3)
    assert change["ci95"] == pytest.approx([-0.339, -0.261], abs=0.005)


def test_an_error_without_bound_is_the_largest():
    rows = [{"axis": "x", "error": -0.3, "ci95": [-0.4, -0.2], "n": 4}, {"axis": "x", "error": 0.1, "n": 4},
            {"axis": "y", "error": None, "n": 4}, {"axis": "z", "error": None, "n": 0}]  # fmt: skip
    assert [fidelity.worst(rows, axis) for axis in "xyz"] == ["-30.0% [-40.0%,-20.0%]", "no bound", "(not measured)"]
    found = fidelity.single_hands({"50": 0.021, "95": None}, {"50": [0.01, 0.03], "95": [0.12, None]})
    assert found == "2.1%, no bound [12.0%,no bound]"


@pytest.mark.parametrize(
    ("intervals", "found"),
    [([[-0.05, 0.01], [0.0, 0.05]], "**yes**"), ([[-0.05, 0.01], [0.0, 0.06]], "undecided"),
     ([[-0.07, -0.06], [0.0, 0.01]], "no"), ([[0.0, 0.01], [0.06, 0.07]], "no"), ([[0.0, 0.01], None], "no"),
     ([], "(not measured)")],
)  # fmt: skip
def test_felt_stiffness_is_within_its_line_if_every_interval_is(intervals, found):
    rows = [{"ci95": interval, "n": 4} for interval in intervals] + [{"ci95": None, "n": 0}]
    assert fidelity.within(rows, 0.05) == found


@pytest.mark.parametrize(
    ("low", "high", "word"),
    [
        (-0.3, -0.2, "holds"),
        (-0.3, -0.19, "undecided"),
        (-0.19, -0.1, "does not hold"),
        (0.1, 0.3, "does not hold"),
    ],
)
def test_better_by_a_fifth_is_a_whole_interval_below(low, high, word):
    found = fidelity.verdict({"mean": (low + high) / 2.0, "ci95": [low, high], "n": 9})
    assert found.startswith(f"**{word}**, ")
    assert found.endswith(f"[{low:+.1%},{high:+.1%}]")


def test_the_upper_agent_is_set_against_the_raw_reference_env_by_env(book, monkeypatch):
    """With each further quarter of its actions arms are off by a tenth less, and single hands by 2 % more."""
    asked, most = {}, 1.0

    def run(self, name, policy, protocol, *options, envs):
        share = {"reference": 0.0}.get(options[-1]) if "--upper-actions" in options else 1.0
        share = float(options[-1]) if share is None else share
        if share > most:
            return None
        asked[name] = policy, protocol, envs
        e_upper = [0.2 * (1.0 - 0.4 * share) * factor for factor in (1.0, 2.0, 3.0)]
        rows = [{"axis": axis, "error": 0.01, "ci95": [0.0, 0.02], "n": 4} for axis in "xyz"]
        self.results[name] = measured(1.0) | {
            "per_env": {"stood": [1.0] * 3, "e_upper": e_upper},
            "metrics": {"e_upper": {"mean": sum(e_upper) / 3.0, "ci95": [0.0, 1.0]}},
            "fidelity": rows, "num_wrong_way": 0, "num_unholdable": 5, "num_touching": 7,
            "error_quantiles": {"50": 0.01, "95": 0.04 + 0.08 * share},
            "error_quantiles_ci95": {"50": [0.0, 0.1], "95": [0.03, 0.05]},
        }  # fmt: skip
        return self.results[name]

    monkeypatch.setattr(Book, "run", run)
    fidelity.fidelity(book)
    page = "\n".join(book.lines)
    assert "| with | joint error | +1.0% [+0.0%,+2.0%] / " in page
    assert "| 5%: **yes** | 1.0%, 12.0% [3.0%,5.0%] | 0 | 7 / 5 |" in page
    assert "| 0 | 0.400±0.600 | - |" in page
    assert "| 0.5 | 0.320±0.680 | -20.0% [-20.0%,-20.0%] |" in page
    assert "at least 20% better than the raw reference: **holds**, -40.0% [-40.0%,-40.0%]." in page
    assert (book.assets / "upper_agent.png").stat().st_size > 5000
    assert len(asked) == 5 + 3 + 4  # tracking at five shares; fidelity at three more than in the table
    assert set(asked.values()) == {("cotap", "velocity-tracking", 4), ("cotap", "fidelity", 4)}
    most, book.lines = 0.5, []  # no verdict on a part of the agent
    fidelity.fidelity(book)
    assert "at least 20%" not in "\n".join(book.lines)


def test_a_walk_is_no_worse_within_a_tenth_or_the_interval():
    base = {"mean": 1.0, "ci95": [0.8, 1.2]}
    assert walking.no_worse({"mean": 1.19}, base)
    assert not walking.no_worse({"mean": 1.21}, base)
    assert walking.no_worse({"mean": 1.09}, {"mean": 1.0, "ci95": [0.99, 1.01]})
    assert walking.no_worse({"mean": None}, base) is None


def test_only_evaluations_of_the_same_policy_and_settings_are_kept(book, monkeypatch):
    """None of another checkpoint or of other options, and no broken file, is taken for what was asked for."""
    asked = []
    book.policies["base"] = str(save_random_policy(book.folder / "policy.pt"))

    def evaluate(arguments):
        asked.append(arguments)
        return measured(1.0) | {"settings": {"checkpoint_sha256": sha256(book.policies["base"])}, "protocol": "impact"}

    monkeypatch.setattr("cotap.evaluate.evaluate", evaluate)
    path = book.evaluations / "row.json"
    book.run("row", "base", "impact", "--alpha", "0.5")
    written = json.loads(path.read_text())
    assert "--per-env" in written["about"]["arguments"]
    book.reuse = True
    about = written["about"]
    for text, kept in (
        (json.dumps(written), True),
        (json.dumps(written | {"about": about | {"checkpoint_sha256": "other"}}), False),
        (json.dumps(written | {"about": about | {"arguments": [*about["arguments"], "--seed", "1"]}}), False),
        ("{", False), ("[1]", False), ("{}", False),
    ):  # fmt: skip
        asked.clear()
        book.results.clear()
        path.write_text(text)
        book.run("row", "base", "impact", "--alpha", "0.5")
        assert (not asked) == kept
    assert str(book.folder) not in json.dumps(book.summary())
    assert book.summary()["rows"]["row"]["arguments"][:3] == ["impact", "--num-envs", "4"]


def test_the_page_says_who_began_from_another_base(book, tmp_path):
    base = save_random_policy(tmp_path / "base.pt")
    book.policies["base"] = str(base)
    for name, begun_from in (("cotap", sha256(base)), ("facet", "0" * 64)):
        path = save_random_policy(tmp_path / f"{name}.pt", "distill")
        content = load_checkpoint(path)
        content["config"]["base"] = {"sha256": begun_from, "runs": []}
        save_checkpoint(path, content)
        book.policies[name] = str(path)
    assert [rp.origin(book, name) for name in ("base", "cotap", "facet")] == ["", "", ", begun from another base"]


@pytest.fixture
def trained(book) -> Book:
    """With policies that have learned nothing."""
    for seed, name in enumerate(("cotap", "facet")):
        (book.folder / name).mkdir()
        book.policies[name] = str(save_random_policy(book.folder / name / "policy.pt", "distill", seed=seed))
    return book


def test_the_laws_beside_cotap_are_a_part_with_facets_own_policy(trained, monkeypatch):
    """Asked of `compare_laws`, kept, and measured again for another policy."""
    at_rest = {"displacement": [0.021, None, 0.09], "half_interval": [0.001, None, 0.002], "torque_saturated": False,
               "num_falls": 0, "num_envs": 6}  # fmt: skip
    names = ("cotap, joint error", "facet", "cotap+facet, joint error")
    static = {"loads_n": (10.0, 30.0, 50.0), "ideal": [0.02, 0.06, 0.1], "rows": dict.fromkeys(names, at_rest)}
    nothing = {"mean": None, "ci95": None, "reason": "nobody stood"}
    keys = ("e_ee_hit", "share_at_limit", "oscillation_energy", "overshoot", "settle_s")
    struck = {
        "metrics_without_falls": dict.fromkeys(keys, nothing),
        "num_falls": 1,
        "num_envs": 4,
        "curve": {"time": []},
    }
    asked = []
    for table, result in ((Static, static), (Transient, {"forces": {"500": {"pd": struck}}})):
        monkeypatch.setattr(table, "measure", lambda self, result=result: asked.append(self) or result)
    facet.facet(trained)
    page = "\n".join(trained.lines)
    assert "| facet | 2.1±0.1 (+5%) | - | 9.0±0.2 (-10%) |  | 0 of 6 | 4.3 / 6.8 / 10.6 |" in page
    assert "ours goes down by 2.1 / - / 9.0 cm." in page
    assert "| pd | (nobody stood) |" in page
    assert "The row *facet* has the policy `facet`" in page
    assert "**500 N for 50 ms, stance, pelvis free, arms held, 500 N/m**" in page
    for name in ("laws_static", "laws_transient"):
        assert (trained.assets / f"{name}.png").stat().st_size > 5000
    for table in asked:
        assert (table.checkpoint, table.facet_checkpoint) == (trained.policies["cotap"], trained.policies["facet"])
        assert (table.null_stiffness, table.upper_actions, table.threads) == (25.0, "policy", 1)
    assert [table.num_envs for table in asked] == [6, 4]  # of a load no fewer than one
    for table in (Static, Transient):  # no more pictures
        monkeypatch.setattr(table, "draw", lambda *_: None)
    monkeypatch.setattr("cotap.evaluation.report.save_figure", lambda *_: None)
    trained.reuse = True
    facet.facet(trained)
    assert len(asked) == 2
    trained.policies["facet"] = trained.policies["cotap"]
    facet.facet(trained)
    assert len(asked) == 4
    del trained.policies["facet"]
    facet.facet(trained)
    assert [table.facet_checkpoint for table in asked[4:]] == ["", ""]
    assert any("all rows have `cotap`" in line for line in trained.lines)


@pytest.mark.parametrize("reuse", [True, False])
def test_sim_to_sim_is_a_part_that_goes_on_where_it_stopped(trained, monkeypatch, reuse):
    trained.reuse, asked = reuse, []
    parts = trained.evaluations / "sim-to-sim"
    parts.mkdir(parents=True)
    (parts / "mujoco-impact.json").touch()

    def compare(path, cfg, jobs, kept):
        asked.append((path.name, cfg.engines, cfg.trials, cfg.perturbed_trials, cfg.load_trials, cfg.motion, jobs))
        assert (kept / "mujoco-impact.json").exists() == reuse
        return {}

    module = "reports.paper.engines"
    monkeypatch.setattr(f"{module}.compare", compare)
    monkeypatch.setattr(f"{module}.markdown", lambda _: "## Impact, arms moving\n\n| a |\n|---|\n")
    monkeypatch.setattr(f"{module}.figure", lambda _, path: path.write_bytes(b"picture"))
    monkeypatch.setattr("cotap.deployment.graph.export_policy", lambda _source, path, checks: path.touch() or checks)
    monkeypatch.setattr(sim_to_sim, "installed", lambda _: (("mujoco",), "pybullet is not installed: not measured."))
    sim_to_sim.sim_to_sim(trained)
    assert asked == [("policy.onnx", ("mujoco",), 4, 4, 4, "mixture", 1)]
    page = "\n".join(trained.lines)
    assert "\n### Impact, arms moving\n\n| a |\n" in page
    assert "pybullet is not installed: not measured." in page
    assert (trained.assets / "sim_to_sim.png").read_bytes() == b"picture"


def test_an_engine_that_is_not_installed_is_named(monkeypatch):
    def make(cfg, spec):
        if cfg.engine == "pybullet":
            raise ModuleNotFoundError(spec.name)
        return SimpleNamespace(close=lambda: None)

    monkeypatch.setattr("cotap.deployment.engines.make_engine", make)
    assert sim_to_sim.installed("h1") == (("mujoco",), "pybullet is not installed: not measured.")


def test_only_the_parts_that_are_asked_for_are_measured(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ran: list[Book] = []
    monkeypatch.setattr(rp, "PARTS", {"impact": ran.append, "load": lambda _: pytest.fail("not asked for")})
    assert rp.main(["--only", "impact", "--reuse", "--threads", "1", "--robot", "g1"]) == 0
    (book,) = ran
    assert (book.envs, book.reuse, book.threads) == (4096, True, 1)
    assert (book.policies["base"], book.policies["cotap"]) == ("g1-base", "g1-cotap")
    page = (tmp_path / "runs/paper/results_g1.md").read_text()
    assert page.startswith("# The paper's tables and figures")
    assert "`python -m reports.reproduce_paper --only impact --reuse --threads 1 --robot g1`: do not edit" in page
    assert json.loads((tmp_path / "runs/paper/results/g1/results.json").read_text())["robot"] == "g1"


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--only", "impacts"], "impacts"),
        (["--policies", "cotap"], "NAME=CHECKPOINT"),
        (["--policies", "best=a.pt"], "best"),
        (["--policies", "goals=missing.pt"], "missing.pt"),
        (["--num-envs", "-1"], "-1"),
        (["--robot", "g1", "--policies", "cotap=h1.pt"], "is of h1, not of g1"),
    ],
)
def test_bad_input_is_named_and_nothing_is_written(options, named, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    save_random_policy(tmp_path / "h1.pt")
    with pytest.raises(SystemExit) as stop:
        rp.main(options)
    assert stop.value.code == 2
    assert named in capsys.readouterr().err
    assert not (tmp_path / "docs").exists()


def test_a_robot_that_fell_is_pictured_as_it_was_before(tmp_path):
    """It begins anew after its fall; a picture of that would show a robot that stands."""
    policy = str(save_random_policy(tmp_path / "policy.pt"))
    args = ["impact", "--num-envs", "1", "--no-randomize", "--checkpoint", policy, "--threads", "1"]
    _, fell_s = pictures(args, (3.0,), 32, 32)
    assert 0.1 < fell_s < 3.0
    (before, late), _ = pictures(args, (fell_s - 0.02, 3.0), 32, 32)
    (early,), stood = pictures(args, (0.02,), 32, 32)
    assert stood == math.inf
    assert np.array_equal(before, late)
    assert not np.array_equal(early, late)


def test_only_what_was_trained_is_spoken_of(book, monkeypatch):
    there = {"base", "cotap"}
    monkeypatch.setattr(Book, "has", lambda _, policy: policy in there)
    monkeypatch.setattr(Book, "checkpoint", lambda *_: {"samples": 15_000_000})
    monkeypatch.setattr(Book, "run", lambda _, __, policy, *___: measured(1.0) | curve if policy in there else None)
    curve = {"curve": {"time": []}}
    monkeypatch.setattr(observation, "plot_curves", lambda *_: None)
    for part in (ablation.ablation, observation.observation):
        monkeypatch.setattr(book, "lines", [])
        part(book)
        assert not any("Ours, trained so" in line or "the ablation begins" in line for line in book.lines)
    there |= {"no-ratio"}
    ablation.ablation(book)
    assert any("Ours, trained so" in line for line in book.lines)


@pytest.mark.slow
@pytest.mark.parametrize(("robot", "parts"), [("h1", ["load", "periodic"]), ("g1", ["load"])])
def test_a_part_end_to_end(robot, parts, tmp_path, monkeypatch):
    """With policies that have learned nothing, and so fall."""
    monkeypatch.chdir(tmp_path)
    policy = save_random_policy(tmp_path / "policy.pt", "distill", robot)
    options = ["--robot", robot, "--quick", "--num-envs", "8", "--threads", "1", "--policies", f"cotap={policy}"]
    assert rp.main([*options, "--only", *parts]) == 0
    page = (tmp_path / "runs/paper-quick" / ("results.md" if robot == "h1" else "results_g1.md")).read_text()
    assert "| K_z 500 |" in page
    assert "100.0 [67.6,100.0]" in page  # all fell
    assert (tmp_path / f"runs/paper-quick/results/{robot}/constant_load.png").stat().st_size > 5000
    kept = json.loads((tmp_path / f"runs/paper-quick/results/{robot}/results.json").read_text())
    assert kept["rows"]["load-PD"]["num_envs"] == 8
