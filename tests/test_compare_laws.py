"""The script that puts laws side by side, small, and the wrong model that it tells them."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import pytest
import torch

from cotap.evaluation.wrong_model import misjudged_arms
from cotap.robots.chains import arm_model

_SPEC = importlib.util.spec_from_file_location(
    "compare_laws", Path(__file__).parents[1] / "scripts" / "compare_laws.py"
)
assert _SPEC is not None
assert _SPEC.loader is not None
compare_laws = sys.modules["compare_laws"] = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(compare_laws)


def test_a_wrong_model_is_longer_and_heavier(spec):
    right, wrong = arm_model(spec), arm_model(misjudged_arms(spec, 1.1, 1.2))
    q = torch.tensor([0.2, 0.3, 0.1, 0.4, 0.2, -0.3, -0.1, 0.4]).reshape(1, 2, 4)
    reach = [m.chains.pose(q).tip - m.chains.pose(q).anchors[:, :, 0] for m in (right, wrong)]
    torch.testing.assert_close(reach[1], 1.1 * reach[0])
    torch.testing.assert_close(wrong.inertias.mass[:, 1:], 1.2 * right.inertias.mass[:, 1:])
    assert torch.equal(wrong.inertias.mass[:, 0], right.inertias.mass[:, 0])


def test_static_table(tmp_path, capsys):
    out = tmp_path / "static.json"
    arguments = ["static", "--pelvis", "fixed", "--repeats", "1", "--settle-seconds", "2", "--threads", "1", "--json",
                 str(out), "--laws", "cotap, task error"]  # fmt: skip
    assert compare_laws.main(arguments) == 0
    content = json.loads(out.read_text())
    assert content["rows"]["cotap, task error"]["displacement"] == pytest.approx(content["ideal"], rel=0.05)
    assert "| cotap, task error | 0.0" in capsys.readouterr().out


def test_properties_table(tmp_path, capsys):
    out = tmp_path / "properties.json"
    arguments = ["properties", "--stability.poses", "4", "--stability.num-envs", "2", "--stability.seconds", "0.2",
                 "--stability.settle-seconds", "0.5", "--settle-seconds", "2", "--threads", "1", "--json", str(out),
                 "--laws", "facet"]  # fmt: skip
    assert compare_laws.main(arguments) == 0
    row = json.loads(out.read_text())["rows"]["facet"]
    assert 1.5 < row["softer_over_stiffer"] < 4.0  # PD's own compliance is in both
    assert row["wrong_over_right_displacement"] != pytest.approx(1.0, abs=1e-3)
    assert "| facet | " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["statics"], "static"), (["static", "--laws", "jazz"], "jazz"), (["static", "--stiffness", "0"], "stiffness"),
     (["properties", "--stability.poses", "0"], "poses"), (["static", "--json", "no/such/x.json"], "no/such")],
)  # fmt: skip
def test_bad_input_is_named(arguments, message, capsys):
    assert compare_laws.main(arguments) == 2
    assert message in capsys.readouterr().err
