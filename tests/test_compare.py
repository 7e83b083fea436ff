"""Differences of two evaluations."""

from __future__ import annotations

import json

import pytest
import torch

from cotap.compare import compare, difference, main, table
from cotap.evaluation.metrics import summarize
from cotap.evaluation.policy import shipped_checkpoint, shipped_names
from cotap.evaluation.report import better, unit


def result(**metrics):
    return {
        "protocol": "impact",
        "method": "pd",
        "settings": {"seed": 0, "env": {"substeps": 2}},
        "metrics": metrics,
        "metrics_without_falls": {},
        "window": {"start": 1.0, "end": 2.0},
    }


def test_difference_by_hand():
    a = {"mean": 1.0, "ci95": [0.7, 1.4]}
    b = {"mean": 2.0, "ci95": [1.6, 2.3]}
    d = difference(a, b)
    assert d["difference"] == 1.0
    assert d["ci95"] == pytest.approx([1.0 - (0.4**2 + 0.4**2) ** 0.5, 1.0 + (0.3**2 + 0.3**2) ** 0.5])


def test_shares_get_newcombes_interval():
    """56 of 70 against 48 of 80: Newcombe (1998) gives 0.0524 to 0.3339 for the difference 0.2."""
    more, less = (summarize(torch.arange(n) < k) for k, n in ((56, 70), (48, 80)))
    d = difference(less, more)
    assert d["difference"] == pytest.approx(0.2)
    assert d["ci95"] == pytest.approx([0.0524, 0.3339], abs=5e-4)


def test_intervals_cover_a_true_difference_at_their_rate():
    rng, hits = torch.Generator().manual_seed(0), 0
    for seed in range(200):
        a = summarize(torch.randn(50, generator=rng), seed, 200)
        b = summarize(0.3 + 2.0 * torch.randn(80, generator=rng), seed, 200)
        low, high = difference(a, b)["ci95"]
        hits += low <= 0.3 <= high
    assert 180 <= hits <= 199


def with_envs(values, stood=None, seed=0):
    r = result(x=summarize(torch.tensor([v for v in values if v is not None])))
    r["per_env"] = {"stood": [1.0] * len(values) if stood is None else stood, "x": values}
    r["settings"]["seed"] = seed
    return r


def test_envs_are_compared_one_by_one():
    """Envs differ by 0 to 99, the two evaluations by 0.5 in each: no doubt about it, however wide the means are."""
    a, b = with_envs([float(i) for i in range(100)]), with_envs([i + 0.5 for i in range(100)])
    row = compare(a, b)["differences"]["x"]
    assert row["difference"] == pytest.approx(0.5)
    assert row["ci95"] == pytest.approx([0.5, 0.5])
    assert row["pairs"] == 100
    other = compare(a, with_envs([i + 0.5 for i in range(100)], seed=1))["differences"]["x"]
    assert "pairs" not in other
    assert other["ci95"][0] < -5.0


def test_envs_that_fell_in_either_are_left_out_of_both():
    a = with_envs([1.0, 2.0, 3.0, 4.0], stood=[0.0, 1.0, 1.0, 1.0])
    b = with_envs([9.0, 2.5, 3.5, None], stood=[1.0, 1.0, 1.0, 1.0])
    for r in (a, b):
        r["metrics_without_falls"] = r["metrics"]
    row = compare(a, b, without_falls=True)["differences"]["x"]
    assert (row["difference"], row["pairs"], row["a"]) == (0.5, 2, 2.5)


def test_shares_keep_their_width_and_one_env_has_none():
    shares = [with_envs([0.0] * 8) for _ in range(2)]
    for r in shares:
        r["metrics"]["x"] = summarize(torch.zeros(8, dtype=torch.bool))
    low, high = compare(shares[0], shares[1])["differences"]["x"]["ci95"]
    assert low < -0.2
    assert high > 0.2
    row = compare(with_envs([1.0, None]), with_envs([2.5, 1.0]))["differences"]["x"]
    assert (row["difference"], row["reason"]) == (None, "fewer than two envs have both")


def test_shares_without_falls_are_of_the_envs_that_stood_in_both():
    """The two agree wherever both stood; the hard envs, in which A fell, say nothing."""
    easy, hard = [1.0] * 30, [0.0] * 20
    a = with_envs(easy + hard, stood=[1.0] * 30 + [0.0] * 20)
    b = with_envs(easy + hard)
    for r, kept in ((a, easy), (b, easy + hard)):
        r["metrics_without_falls"] = {"x": summarize(torch.tensor(kept).bool())}
    row = compare(a, b, without_falls=True)["differences"]["x"]
    assert (row["a"], row["b"], row["b_is"]) == (1.0, 1.0, "not distinguishable")


def test_slopes_are_compared_too():
    a, b = (result() | {"slopes": {"slope_x": s}, "slopes_ci95": {"slope_x": [s - 0.1, s + 0.1]}} for s in (0.5, 0.9))
    assert compare(a, b)["differences"]["slope_x"]["difference"] == pytest.approx(0.4)
    with pytest.raises(ValueError, match="no measure in common"):
        compare(a, b, without_falls=True)


@pytest.mark.parametrize(
    ("slopes", "intervals", "named"),
    [
        ([], {}, "slopes and slopes_ci95 must be objects"),
        ({"slope_x": 1.0}, {}, "of the same names"),
        ({"slope_x": "1"}, {"slope_x": None}, "slopes.slope_x.mean must be a finite number"),
        ({"slope_x": 1.0}, {"slope_x": [1.0]}, "slopes.slope_x.ci95 must be two finite numbers"),
    ],
)
def test_slopes_that_are_none_are_refused(tmp_path, capsys, slopes, intervals, named):
    file = tmp_path / "a.json"
    file.write_text(json.dumps(result() | {"slopes": slopes, "slopes_ci95": intervals}))
    assert main([str(file), str(file)]) == 2
    assert named in capsys.readouterr().err


@pytest.mark.parametrize(
    ("envs", "named"),
    [
        ([], "stood among them"),
        ({"x": [1.0]}, "stood among them"),
        ({"stood": [1.0], "x": 1.0}, "stood among them"),
        ({"stood": [1.0], "x": [1.0, 2.0]}, "per_env.x has 2 envs"),
        ({"stood": [1.0], "x": ["1"]}, "finite numbers or null, got '1'"),
        ({"stood": [None], "x": [1.0]}, "stood must be 0 or 1, got None"),
        ({"stood": [0.5], "x": [1.0]}, "stood must be 0 or 1, got 0.5"),
    ],
)
def test_envs_that_are_none_are_refused(tmp_path, capsys, envs, named):
    file = tmp_path / "a.json"
    file.write_text(json.dumps(result(x={"mean": 1.0, "ci95": [0.5, 1.5]}) | {"per_env": envs}))
    assert main([str(file), str(file)]) == 2
    assert named in capsys.readouterr().err


@pytest.mark.parametrize(
    ("measure", "b", "shown", "b_is"),
    [("e_torso", 1.5, "e_torso (less)", "worse"), ("force_e_ee", 0.5, "force_e_ee (less)", "better"),
     ("still_share", 1.5, "still_share (more)", "better"),
     ("survival_s", 0.5, "survival_s (more)", "worse"),
     ("displacement_x", 0.5, "displacement_x", "less"), ("e_yaw", 1.01, "e_yaw (less)", "not distinguishable")],
)  # fmt: skip
def test_what_is_better_is_said(measure, b, shown, b_is):
    summaries = [{measure: {"mean": v, "ci95": [v - 0.1, v + 0.1]}} for v in (1.0, b)]
    out = compare(*(result(**s) for s in summaries))
    assert out["differences"][measure]["b_is"] == b_is
    (row,) = (line for line in table(out).splitlines() if measure in line)
    assert row.startswith(f"| {shown} |")
    assert row.endswith(f"| {b_is} |")


def test_every_measure_that_is_written_has_a_direction_or_has_none_on_purpose():
    shipped = shipped_checkpoint(shipped_names()[0]).parent
    measures = {name for file in shipped.glob("*.*.json") for name in json.loads(file.read_text())["metrics"]}
    neither = {"j_upper", "j_upper_push", "peak_torque", "energy", "swing_height", "stride_rate", "displacement_x",
               "displacement_y", "displacement_z", "condition_number", "singular_share", "null_share"}  # fmt: skip
    assert {name for name in measures if not better(name)} <= neither
    assert len(measures) > 15


@pytest.mark.parametrize("missing", [0, 1])
def test_a_file_that_is_not_there_is_named(tmp_path, capsys, missing):
    files = [tmp_path / "a.json", tmp_path / "b.json"]
    files[1 - missing].write_text(json.dumps(result(x={"mean": 1.0, "ci95": [0.9, 1.1]})))
    assert main([str(file) for file in files]) == 2
    assert capsys.readouterr().err == f"error: {str(files[missing])!r} does not exist\n"


def test_that_the_result_cannot_be_written_is_found_first(tmp_path, capsys):
    assert main(["none.json", "none.json", "--json", str(tmp_path / "no" / "out.json")]) == 2
    assert "its folder does not exist" in capsys.readouterr().err


def test_what_one_could_not_measure_is_null_with_the_reason():
    none = {"mean": None, "ci95": None, "reason": "no env"}
    d = difference(none, {"mean": 1.0, "ci95": [0.5, 1.5]})
    assert d["difference"] is None
    assert d["reason"] == "A: no env"


def test_settings_that_differ_are_listed():
    a, b = result(x={"mean": 1.0, "ci95": [0.9, 1.1]}), result(x={"mean": 1.5, "ci95": [1.4, 1.6]}, y={})
    b["settings"]["env"]["substeps"] = 4
    b["method"] = "cotap"
    out = compare(a, b)
    assert list(out["differences"]) == ["x"]
    assert out["settings"] == {"env.substeps": [2, 4], "method": ["pd", "cotap"]}


def test_the_command(tmp_path, capsys):
    a, b = tmp_path / "a.json", tmp_path / "b.json"
    a.write_text(json.dumps(result(x={"mean": 1.0, "ci95": [0.9, 1.1]})))
    b.write_text(json.dumps(result(x={"mean": 1.5, "ci95": [1.4, 1.6]})))
    assert main([str(a), str(b), "--json", str(tmp_path / "out.json")]) == 0
    assert "| x | 1.0000 | 1.5000 | +0.5000 | +0.3586 to +0.6414 | more |" in capsys.readouterr().out
    assert json.loads((tmp_path / "out.json").read_text())["differences"]["x"]["difference"] == 0.5


@pytest.mark.parametrize("text", ["not json", "[]", '{"protocol": "impact"}'])
def test_files_that_are_no_evaluations_are_named(text, tmp_path, capsys):
    path = tmp_path / "a.json"
    path.write_text(text)
    assert main([str(path), str(path)]) == 2
    assert "a.json" in capsys.readouterr().err


def test_what_has_no_measure_in_common_is_not_compared(tmp_path, capsys):
    for name, content in (("a", {"e_lin": summarize(torch.rand(9))}), ("b", {"e_yaw": summarize(torch.rand(9))})):
        (tmp_path / name).write_text(json.dumps(result(**content)))
    assert main([str(tmp_path / "a"), str(tmp_path / "b")]) == 2
    assert "no measure in common" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("measure", "expected"),
    [("elbow_amplitude_static_left", "Nm"), ("energy_right", "J"), ("force_e_ee", "m"), ("settled_fraction", ""),
     ("elbow_rms_ratio", "")],
)  # fmt: skip
def test_a_measure_of_one_side_or_after_a_force_has_its_unit(measure, expected):
    assert unit(measure) == expected


def test_other_protocols_are_not_compared(tmp_path, capsys):
    a, b = tmp_path / "a.json", tmp_path / "b.json"
    a.write_text(json.dumps(result()))
    b.write_text(json.dumps(result() | {"protocol": "tour"}))
    assert main([str(a), str(b)]) == 2
    assert "protocols differ: 'impact' and 'tour'" in capsys.readouterr().err
    assert main([str(a), str(tmp_path / "none.json")]) == 2
