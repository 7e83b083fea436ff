"""Every command that README and docs show is one that the package understands; those that need nothing are run.

A command is understood if its words are parsed and its work would begin: the work is replaced by an interruption.
"""

from __future__ import annotations

import importlib
import importlib.util
import re
import shlex
from pathlib import Path

import pytest

from cotap.__main__ import _first_unknown, _named
from cotap.command_help import load_commands

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
WORK = {
    "evaluate": ("cotap.evaluate", ("run", "recording")),
    "export": ("cotap.export", ()),  # its work is found elsewhere
    "compare": ("cotap.compare", ("read",)),
    "motions": ("cotap.motions.__main__", ("_import", "_show")),
    "deploy": ("cotap.deploy", ("deploy",)),
    "train": ("cotap.train", ("train_both", "train_base", "train_distill")),
    "play": ("cotap.play.__main__", ("_run",)),
}
BY_HAND = ("git clone", "python3 -m venv", "pip install", "python -m pip install", "torchrun", "tensorboard", "ssh")
"""Beginnings of commands of other programs; `python -m pytest tests/test_torchrun.py` runs the fourth."""
FILLED_IN = {
    "PROTOCOL": "impact",
    "COMMAND": "export",
    "[options]": "",
    "AMASS_FILE_OR_FOLDER": "motion.npz",
    "FILE_OR_FOLDER...": "a.npz",
}


def in_blocks(text: str) -> set[str]:
    """The lines of a page's blocks of code that are commands."""
    blocks = "\n".join(re.findall(r"^```(?:sh|bash|console)?\n(.*?)^```", text, re.S | re.M))
    blocks += "\n" + "\n".join(re.findall(r"^    (\S.*)$", text, re.M))
    begins = re.compile(r"^(cotap |make |python |\.venv/|git clone|python3 |pip |torchrun|tensorboard|ssh )")
    lines = [part.strip() for line in blocks.splitlines() for part in line.split("&&")]
    return {re.sub(r"\s{2,}#.*", "", line) for line in lines if begins.match(line)}


def in_text(text: str) -> set[str]:
    """What sentences and tables say of commands, which may be without the values of options."""
    return {piece for piece in re.findall(r"`((?:cotap|make|python -m) [^`]+)`", text) if "..." not in piece}


TEXTS = [re.sub(r"\\\n\s+", "", page.read_text(encoding="utf-8")) for page in PAGES]  # lines that go on, whole
COMMANDS = sorted(set().union(*map(in_blocks, TEXTS)))
MENTIONED = sorted(set().union(*map(in_text, TEXTS)) - set(COMMANDS))


def words(command: str) -> list[str]:
    """A command's words: placeholders filled in, the first of alternatives taken, optional parts left in."""
    for placeholder, value in FILLED_IN.items():
        command = command.replace(placeholder, value)
    return shlex.split(re.sub(r"(\w+)(\|[\w-]+)+", r"\1", command.replace("[", "").replace("]", "")))


def test_commands_are_found_at_all():
    assert len(COMMANDS) > 40
    assert {"cotap play", "cotap train --quick --run-dir runs/quick"} <= set(COMMANDS)
    assert {"make demo", "make test"} <= set(MENTIONED)


@pytest.mark.parametrize("command", [c for c in COMMANDS if c.startswith("cotap ")])
@pytest.mark.usefixtures("in_tmp_path")
def test_a_command_of_cotap_is_understood(command, monkeypatch, capsys):
    def interrupted(*_args, **_options):
        raise KeyboardInterrupt

    _, name, *args = words(command)
    module, functions = WORK[name]
    for function in functions:
        monkeypatch.setattr(f"{module}.{function}", interrupted)
    monkeypatch.setattr("cotap.deployment.graph.export_policy", interrupted)
    Path("runs/both").mkdir(parents=True)
    status: int | str | None
    try:
        status = importlib.import_module(module).main(args)
    except SystemExit as stop:  # of the parser
        status = stop.code
    assert status == (0 if name == "play" else 130), capsys.readouterr().err


@pytest.mark.parametrize("command", [c for c in MENTIONED if c.startswith("cotap ")])
def test_a_command_that_is_mentioned_has_what_is_said_of_it(command):
    commands = load_commands()
    name, rest = _named(words(command)[1:], commands)
    assert name, "no such command"
    assert not _first_unknown(rest, commands[name])
    assert not commands[name].parts or name == "train" or not rest or rest[0].startswith("-"), f"no such part: {rest}"


@pytest.mark.parametrize("command", [c for c in [*COMMANDS, *MENTIONED] if not c.startswith("cotap ")])
def test_any_other_command_names_what_there_is(command):
    if command.startswith(BY_HAND) or command.startswith("."):
        return
    program, *rest = words(command)
    if program == "make":
        assert re.search(rf"^{rest[0]}:", (ROOT / "Makefile").read_text(), re.M)
    elif rest[0] == "-m":
        assert importlib.util.find_spec(rest[1]) is not None
        source = Path(str(importlib.util.find_spec(rest[1]).origin)).read_text()  # pyright: ignore
        assert '__name__ == "__main__"' in source or rest[1] in ("benchmarks", "reports", "release")
    else:
        assert (ROOT / rest[0]).is_file() or (ROOT / "examples" / rest[0]).is_file()
