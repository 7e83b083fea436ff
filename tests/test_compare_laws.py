"""The script that puts laws side by side, small, and a wrong model of the arms."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import torch
from random_policy import save_random_policy

from cotap.compliance.laws import LawConfig, reads
from cotap.envs.upper_body import UpperBodyConfig
from cotap.evaluation.policy import find_checkpoint, load_policy
from cotap.robots.chains import arm_model
from reports import compare_laws
from reports.wrong_model import misjudged_arms


def test_a_wrong_model_is_longer_and_heavier(spec):
    right, wrong = arm_model(spec), arm_model(misjudged_arms(spec, 1.1, 1.2))
    q = torch.tensor([0.2, 0.3, 0.1, 0.4, 0.2, -0.3, -0.1, 0.4]).reshape(1, 2, 4)
    reach = [m.chains.pose(q).tip - m.chains.pose(q).anchors[:, :, 0] for m in (right, wrong)]
    torch.testing.assert_close(reach[1], 1.1 * reach[0])
    torch.testing.assert_close(wrong.inertias.mass[:, 1:], 1.2 * right.inertias.mass[:, 1:])
    torch.testing.assert_close(wrong.inertias.com[:, 1:], 1.1 * right.inertias.com[:, 1:])
    # What the first link has, and every link's inertia about its own centre of mass, are as they are.
    assert torch.equal(wrong.inertias.mass[:, 0], right.inertias.mass[:, 0])
    assert torch.equal(wrong.inertias.com[:, 0], right.inertias.com[:, 0])
    assert torch.equal(wrong.inertias.inertia, right.inertias.inertia)


@pytest.fixture(scope="module")
def policy(tmp_path_factory) -> list[str]:
    """Some policy: with a fixed pelvis it is not asked."""
    return ["--checkpoint", str(save_random_policy(tmp_path_factory.mktemp("policy") / "policy.pt"))]


@pytest.mark.parametrize("table", ["static", "transient"])
def test_without_a_checkpoint_the_shipped_policy_is_measured(table, tmp_path, monkeypatch):
    class Asked(Exception):
        pass

    def run(protocol, options):
        raise Asked(protocol, options.checkpoint, load_policy(find_checkpoint(options.checkpoint)).stage)

    monkeypatch.setattr(compare_laws, "run", run)
    with pytest.raises(Asked) as asked:
        compare_laws.main([table, "--output", str(tmp_path)])
    protocol = {"static": "static-stiffness", "transient": "impact"}[table]
    assert asked.value.args == (protocol, "h1-cotap", "distill")


@pytest.mark.parametrize("table", [compare_laws.Static, compare_laws.Transient])
def test_facet_alone_has_a_policy_of_its_own(table):
    options = table(checkpoint="a.pt", facet_checkpoint="b.pt")
    others = {compare_laws.policy_of(options, name) for name in options.laws if name != "facet"}
    assert (compare_laws.policy_of(options, "facet"), others) == ("b.pt", {"a.pt"})
    assert compare_laws.policy_of(table(checkpoint="a.pt"), "facet") == "a.pt"


def test_rows_are_what_they_are_called_whatever_the_policy_was_trained_with():
    other = LawConfig("cotap", alpha=0.4, error="task", damping="pd")
    for name in compare_laws.ROWS:
        arms = compare_laws.laws_of(name, 500.0, 25.0).configure(UpperBodyConfig(other, other))
        if reads(arms.left.name, "error"):
            assert arms.left.error == ("task" if "task error" in name else "joint"), name
            assert arms.left.damping == ("pd" if "PD's damping" in name else "critical"), name
        if reads(arms.left.name, "alpha"):
            assert arms.left.alpha == (0.5 if "alpha 0.5" in name else 1.0), name


def small(table: str, folder: Path, *options: str) -> dict:
    """What a table measures; Markdown and picture are there, too."""
    assert compare_laws.main([table, "--threads", "1", "--output", str(folder), *options]) == 0
    assert (folder / f"{table}.png").stat().st_size > 5000
    return json.loads((folder / f"{table}.json").read_text())


@pytest.mark.slow
def test_static_table(tmp_path, capsys, policy):
    options = ["--pelvis", "fixed", "--num-envs", "6", "--settle-seconds", "2", "--laws", "cotap, task error", "facet"]
    content = small("static", tmp_path, *policy, *options)
    assert content["rows"]["cotap, task error"]["displacement"] == pytest.approx(content["ideal"], rel=0.05)
    text = (tmp_path / "static.md").read_text()
    assert text in capsys.readouterr().out
    assert re.search(r"\| cotap, task error \| 2\.0 \([+-]\d%\) \|", text)  # 10 N at 500 N/m
    assert "4.3 / 6.8 / 10.6 |" in text  # the paper's


@pytest.mark.slow
def test_transient_table(tmp_path, policy):
    """A law that adds no damping to that of PD, and one that is damped critically: the second does not swing."""
    options = ["--pelvis", "fixed", "--num-envs", "2", "--forces", "200", "--laws", "facet", "cotap, task error"]
    content = small("transient", tmp_path, *policy, *options)
    rows = content["forces"]["200"]
    assert rows["facet"]["metrics_without_falls"]["overshoots"]["mean"] >= 1.0
    text = (tmp_path / "transient.md").read_text()
    (line,) = (line for line in text.splitlines() if line.startswith("| cotap, task error |"))
    assert "| **less** |" in line


@pytest.mark.slow
def test_properties_table(tmp_path):
    content = small("properties", tmp_path, "--stability.poses", "4", "--stability.num-envs", "2",
                    "--stability.episode-seconds", "0.2", "--stability.settle-seconds", "0.5", "--settle-seconds", "2",
                    "--laws", "facet")  # fmt: skip
    row = content["rows"]["facet"]
    assert 1.5 < row["softer_over_stiffer"] < 4.0  # PD's own compliance is in both
    text = (tmp_path / "properties.md").read_text()
    assert "a wrong model has joint offsets and centres of mass 1.1 times as far out" in text
    assert row["wrong_over_right_displacement"] != pytest.approx(1.0, abs=1e-3)
    assert "| yes / no / no |" in text  # the paper's
    energy = row["energy"]["changing_stiffness"]
    assert ("| facet | changing | " in text) == bool(energy["share_drawn"] or energy["num_diverged"])


def test_the_page_of_the_properties_is_the_table_of_its_numbers():
    page = Path(__file__).parents[1] / "docs/laws/properties.md"
    table = compare_laws.Properties().table(json.loads(page.with_suffix(".json").read_text()))
    assert page.read_text() == table + "\n"
    assert "| facet | changing | -0.0210 | -2.6872 | 0.8% of 128 | 0 |" in table  # by hand, from the JSON
    assert "| pd | changing | " not in table  # gave nothing away


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["statics"], "static"), (["static", "--laws", "jazz"], "jazz"), (["static", "--stiffness", "0"], "stiffness"),
     (["properties", "--stability.poses", "0"], "poses"), (["properties", "--load", "0"], "load"),
     (["properties", "--settle-seconds", "0.5"], "settle_seconds"), (["properties", "--robot", "h2"], "h2"),
     (["transient", "--num-envs", "0"], "num_envs"), (["static", "--output", "FILE"], "FILE")],
)  # fmt: skip
def test_bad_input_is_named(arguments, message, capsys, tmp_path):
    (tmp_path / "FILE").touch()
    folder = [] if "--output" in arguments else ["--output", str(tmp_path)]
    assert compare_laws.main([a.replace("FILE", str(tmp_path / "FILE")) for a in arguments] + folder) == 2
    assert message in capsys.readouterr().err
