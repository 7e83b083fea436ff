"""`python -m cotap` says which commands there are."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import cotap
from cotap.__main__ import COMMANDS, main


def test_the_package_lists_its_commands():
    done = subprocess.run([sys.executable, "-m", "cotap"], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    for name, what in COMMANDS.items():
        (line,) = (line for line in done.stdout.splitlines() if line.startswith(f"  python -m cotap.{name} "))
        assert line.endswith(what)


def test_all_commands_are_listed_and_no_other():
    package = Path(cotap.__file__).parent
    single = {file.stem for file in package.glob("*.py") if "__main__" in file.read_text() and file.stem != "__main__"}
    packages = {file.parent.name for file in package.glob("*/__main__.py")}
    assert single | packages == COMMANDS.keys()
    assert all(importlib.util.find_spec(f"cotap.{name}") for name in COMMANDS)


def test_a_command_is_a_module(capsys):
    assert main(["evaluate"]) == 2
    assert "run python -m cotap.evaluate" in capsys.readouterr().err
    assert main(["dance"]) == 2
    assert "got 'dance'; known: train, evaluate" in capsys.readouterr().err
