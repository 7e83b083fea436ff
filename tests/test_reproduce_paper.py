"""The page that reports.reproduce_paper writes: verdicts, missing checkpoints, numbers as they were measured."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from random_policy import save_random_policy

from cotap.agents.checkpoint import sha256
from reports import reproduce_paper as rp


@pytest.fixture
def book(tmp_path: Path) -> rp.Book:
    policies = {"base": str(save_random_policy(tmp_path / "policy.pt"))}
    return rp.Book(tmp_path, tmp_path, 4, 1, False, policies)


def measured(mean: float, half: float) -> dict:
    summary = {"mean": mean, "std": 1.0, "ci95": [mean - half, mean + half]}
    measures = dict.fromkeys(("j_upper", "j_upper_blow", "e_torso"), summary)
    return {"metrics_without_falls": measures, "settings": {"seed": 0}}


@pytest.mark.parametrize(
    ("larger", "verdict"),
    [(20.0, "holds"), (5.0, "does not hold"), (10.2, "cannot be distinguished"), (None, "not measured")],
)
def test_an_ordering_gets_the_verdict_that_its_interval_allows(book, larger, verdict):
    book.results["small"] = measured(10.0, 0.5)
    if larger is not None:
        book.results["large"] = measured(larger, 0.5)
    rp.ordering(book, "claim", "small", "large", "j_upper")
    assert verdict in book.lines[-1]


def test_numbers_are_shown_with_interval_or_reason():
    assert rp.number({"mean": 0.12345, "ci95": [0.1, 0.2]}) == "0.123 (0.100 to 0.200)"
    assert rp.number({"mean": None, "ci95": None, "reason": "no env stood"}) == "no env stood"
    assert rp.number({"mean": 31.0, "ci95": None, "reason": "wide"}, 0) == "31 (wide)"


def test_what_there_is_no_checkpoint_of_is_a_row_that_says_so(book, monkeypatch):
    book.policies = {}
    monkeypatch.setattr("cotap.evaluate.evaluate", lambda *_: pytest.fail("nothing may be measured"))
    rp.impacts(book, "stance", "cotap", 1.0, "mixture")
    rows = [line for line in book.lines if line.startswith("| K 100")]
    assert "no checkpoint of `cotap`: not measured" in rows[0]
    assert "0.861 / 0.101 / 46.664" in rows[0]  # the paper's own stay
    assert not book.results
    rp.ablations(book, "mixture", True)
    rp.periodic(book)
    rp.torque_observation(book)
    rp.fidelity(book, True)
    rp.robustness(book, True)
    assert sum("not measured" in line for line in book.lines) >= 20


def test_an_error_without_bound_is_the_largest(book, monkeypatch):
    rows = [{"axis": "x", "error": -0.3, "n": 4}, {"axis": "y", "error": None, "n": 4},
            {"axis": "z", "error": None, "n": 0}]  # fmt: skip
    result = {"fidelity": rows, "num_wrong_way": 3, "coverage": 0.5, "num_falls": 1, "num_envs": 12,
              "num_unholdable": 2, "error_quantiles": {"50": 0.021, "95": 0.15}}  # fmt: skip
    monkeypatch.setattr(book, "run", lambda *_, **__: result)
    rp.fidelity(book, True)
    assert "| cotap | joint | no bound | -30% / no bound / - | 2.1%, 15% | 3 | 2 | 50% | 1 of 12 |" in book.lines
    result["error_quantiles"]["95"] = None
    rp.fidelity(book, True)
    assert "| cotap | joint | no bound | -30% / no bound / - | 2.1%, no bound | 3 | 2 | 50% | 1 of 12 |" in book.lines


def test_the_papers_tables_have_seven_rows_each():
    assert all(len(rows) == len(rp.ROWS) == 7 for rows in rp.IMPACT.values())
    assert set(rp.ROWS) <= set(rp.ARMS)


def test_page_and_json_are_written(book, tmp_path):
    book.add("# Title")
    book.results["x"] = measured(1.0, 0.1) | {"curve": [1] * 1000, "settings": {"seed": 7, "env": {"robot": "h1"}}}
    rp.write(tmp_path, book)
    assert (tmp_path / "results.md").read_text() == "# Title\n"
    written = json.loads((tmp_path / "results.json").read_text())["rows"]["x"]
    assert written.keys() == {"metrics_without_falls", "settings"}
    assert written["settings"] == {"seed": 7}


def test_only_evaluations_of_the_same_policy_and_settings_are_kept(book, monkeypatch):
    """Neither one of another checkpoint nor one of other envs or options is taken for what was asked for."""
    asked = []

    def evaluate(arguments):
        asked.append(arguments)
        return {"settings": {"checkpoint_sha256": sha256(book.policies["base"])}}

    monkeypatch.setattr("cotap.evaluate.evaluate", evaluate)
    path = book.evaluations / "row.json"
    book.run("row", "base", "impact", "--alpha", "0.5")
    written = json.loads(path.read_text())
    assert "--per-env" in written["arguments"]
    book.reuse = True
    for changed, kept in (
        ({}, True),
        ({"settings": {"checkpoint_sha256": "other"}}, False),
        ({"arguments": [*written["arguments"], "--seed", "1"]}, False),
    ):
        asked.clear()
        path.write_text(json.dumps(written | changed))
        book.run("row", "base", "impact", "--alpha", "0.5")
        assert (not asked) == kept


def test_differences_say_what_was_measured_and_what_was_not(book):
    rp.differences(book)
    page = "\n".join(book.lines)
    assert "(not measured)" in page
    assert "of 51 kg by 0.49 m/s" in page
    assert "{" not in page
    for row, mean in (("K-100", 1.0), ("PD-kp-100", 3.0)):
        book.results[f"impact-stance-cotap-{row}"] = measured(mean, 0.1) | {"num_falls": 1, "num_envs": 8}
    rp.differences(book)
    page = "\n".join(book.lines)
    assert "less ours under PD: -2.000 (-2.141 to -1.859) m/s" in page
    assert "Of ours 12.5 % (2.2 to 47.1) fall" in page
    assert book.differences["e_torso: impact-stance-cotap-K-100 - impact-stance-cotap-PD-kp-100"]["difference"] == -2.0


@pytest.mark.slow
def test_a_part_end_to_end(tmp_path, monkeypatch):
    """With a policy that has learned nothing, and so falls."""
    monkeypatch.chdir(tmp_path)
    policy = save_random_policy(tmp_path / "policy.pt", "distill")
    arguments = ["--quick", "--num-envs", "8", "--threads", "1", "--policies", f"cotap={policy}", f"base={policy}"]
    monkeypatch.setattr(sys, "argv", ["reproduce_paper.py", *arguments, "--only", "load", "periodic"])
    assert rp.main() == 0
    page = (tmp_path / "runs/paper-quick/results.md").read_text()
    assert "| K_z 500 |" in page
    assert (tmp_path / "runs/paper-quick/results/periodic_load_base.png").stat().st_size > 5000
