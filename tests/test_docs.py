"""Examples in the documentation run, and are what the page shows; what it says of imports is so."""

from __future__ import annotations

import ast
import re
import runpy
from pathlib import Path

import pytest
import torch

from cotap.compliance.laws import LAWS

DOCS = Path(__file__).parents[1] / "docs"


def test_the_compliance_example_runs_and_is_the_one_shown(capsys):
    example = DOCS / "examples" / "compliance.py"
    result = runpy.run_path(str(example))
    assert result["torque"].shape == (1, 2, 4)
    assert torch.isfinite(result["torque"]).all()
    assert "tensor" in capsys.readouterr().out
    shown = example.read_text().split('"""\n\n', 1)[1]
    assert shown in (DOCS / "compliance.md").read_text()


def test_the_law_of_ones_own_runs_and_is_the_one_shown(monkeypatch):
    monkeypatch.setitem(LAWS, "floating-pd", None)  # so that what the example adds is taken out again
    example = DOCS / "examples" / "law.py"
    soft, stiff = runpy.run_path(str(example))["sag"].tolist()
    # Joints 0.4 times as stiff: the hand gives 2.5 times as far.
    assert 0.005 < stiff < 0.015
    assert soft / stiff == pytest.approx(2.5, rel=0.1)
    assert example.read_text().split('"""\n\n', 1)[1] in (DOCS / "laws.md").read_text()


def test_the_passive_arm_gives_away_no_more_than_its_store_had():
    example = DOCS / "examples" / "passive_arm.py"
    text = example.read_text()
    assert text.count("\n") < 60
    assert set(re.findall(r"^(?:import|from) (\S+)", text, re.M)) == {"torch", "cotap.compliance.passivity"}
    run = runpy.run_path(str(example))["run"]
    assert run(filtered=False, steps=600) > 3.0
    assert 0.5 < run(filtered=True, steps=600) < 1.01  # its first filling is 1 J; the rest is integration


def test_modules_import_what_the_table_of_the_architecture_lets_them():
    rows = re.findall(r"^\| ([\w, ]+) \| ([^|]+) \|$", (DOCS / "architecture.md").read_text(), re.M)
    table = {name.strip(): set(re.findall(r"\w+", may)) for names, may in rows for name in names.split(",")}
    package = DOCS.parent / "src/cotap"
    seen: set[tuple[str, str]] = set()
    for file in package.rglob("*.py"):
        own = file.relative_to(package).parts[0].removesuffix(".py")
        for line in ast.walk(ast.parse(file.read_text())):
            if isinstance(line, ast.ImportFrom) and (line.module or "").startswith("cotap."):
                seen.add((own, (line.module or "").split(".")[1]))
    packages = {p.name for p in package.iterdir() if (p / "__init__.py").is_file()}
    assert packages - {"play", "motions", "sim"} <= table.keys()  # the table is read at all
    free = {name for name, may in table.items() if "everything" in may} | {
        "train",
        "evaluate",
        "export",
        "deploy",
        "compare",
    }
    wrong = {(a, b) for a, b in seen if a != b and a not in free and b not in table.get(a, set())}
    assert not wrong, f"imports that docs/architecture.md does not name: {sorted(wrong)}"
