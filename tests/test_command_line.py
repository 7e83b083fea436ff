"""The command `cotap`: what it answers by itself, and what it hands over."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

import cotap
from cotap.__main__ import main
from cotap.command_help import Command, Option, dump_commands, load_commands, show, unknown
from release.build_help import ABOUT, FILE, build

COMMANDS = load_commands()


def test_help_is_what_the_parsers_read():
    assert dump_commands(build()) == FILE.read_text(encoding="utf-8"), "run python -m release.build_help"


def test_all_commands_are_listed_and_no_other():
    package = Path(cotap.__file__).parent
    single = {file.stem for file in package.glob("*.py") if "__main__" in file.read_text() and file.stem != "__main__"}
    packages = {file.parent.name for file in package.glob("*/__main__.py")}
    assert (single | packages) - {"command_help"} == ABOUT.keys() == COMMANDS[""].parts.keys()


@pytest.mark.parametrize("name", COMMANDS)
def test_help_fits_a_screen(name: str, capsys: pytest.CaptureFixture[str]):
    assert main([*name.split(), "--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 50
    assert max(map(len, lines)) <= 80
    assert lines[0].startswith(f"usage: cotap {name}".rstrip())


@pytest.mark.parametrize("name", [name for name, command in COMMANDS.items() if command.options])
def test_full_help_has_every_option_and_every_word(name: str, capsys: pytest.CaptureFixture[str]):
    assert main([*name.split(), "--help-all"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    for option in COMMANDS[name].options:
        assert ", ".join(option.flags) in shown
        assert option.help in shown


def test_options_of_a_training_are_all_there():
    flags = COMMANDS["train base"].flags()
    assert {"--num-envs", "--env.num-envs", "--robot", "--seed", "--ppo.clip", "--env.rewards.lower.foot-slip"} <= {
        *flags
    }


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("dance", "unknown command 'dance'; known: train, evaluate"),
        ("evaluat impact", "unknown command 'evaluat'; did you mean evaluate?"),
        ("train bas", "unknown stage 'bas'; did you mean base?"),
        ("evaluate impakt", "unknown protocol 'impakt'; did you mean impact?"),
        ("motions shwo", "unknown command 'shwo'; did you mean show?"),
        (
            "evaluate impact --stifness 4",
            "cotap evaluate impact: unknown option '--stifness'; did you mean --stiffness",
        ),
        ("train base --env.num-env=3", "unknown option '--env.num-env'; did you mean --env.num-envs"),
        ("export --chekpoint x", "did you mean --checkpoint"),
    ],
)
def test_what_is_not_known_is_answered_with_the_nearest(arguments: str, message: str, capsys):
    assert main(arguments.split()) == 2
    assert message in capsys.readouterr().err


def test_questions_import_nothing_heavy():
    code = (
        "import sys; from cotap.__main__ import main\n"
        "for line in ('', 'train base --help', 'evaluate impakt', 'evaluate impact --help-all', 'play --x'):\n"
        "    main(line.split())\n"
        "heavy = {'torch', 'mujoco', 'tyro', 'scipy', 'matplotlib', 'tensordict'} & sys.modules.keys()\n"
        "sys.exit(str(heavy) if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-500:]


def test_options_are_handed_over_as_they_were_typed(monkeypatch: pytest.MonkeyPatch):
    """In either spelling, with a value after a sign of equality or a space, negative numbers too."""
    seen: list[list[str]] = []
    for name in ("evaluate", "train"):
        module = importlib.import_module(f"cotap.{name}")
        monkeypatch.setattr(module, "main", lambda args: seen.append(args) or 7)
    typed = ["impact", "--num_envs=3", "--force", "-1", "0", "-2.5", "--no-randomize"]
    assert main(["evaluate", *typed]) == 7
    assert main(["train", "--quick"]) == 7
    assert main(["train", "base", "--help", "--resume", "x.pt"]) == 7  # the defaults are those of the run
    assert seen == [typed, ["--quick"], ["base", "--help", "--resume", "x.pt"]]


def test_a_missing_package_is_named_with_its_cure(monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.delitem(sys.modules, "cotap.compare", raising=False)
    monkeypatch.setitem(sys.modules, "tyro", None)
    assert main(["compare", "a.json", "b.json"]) == 2
    assert "cotap compare needs tyro: in cotap's folder, pip install -e '.[train]'" in capsys.readouterr().err


def test_help_in_short_has_first_sentences_whole_and_help_in_full_all_of_them():
    option = Option(
        ("--size",), "FLOAT", "How large the box of 2.5 kg is, and not how heavy [m]. More of it.", "0.1 0.2"
    )
    shown = show("x", Command("about", {}, (option,))).splitlines()
    assert shown[5] == "  --size FLOAT               How large the box of 2.5 kg is, and not how heavy"
    assert shown[6] == " " * 29 + "[m]. (0.1 0.2)"
    full = " ".join(show("x", Command("about", {}, (option,)), everything=True).split())
    assert "[m]. More of it. (default: 0.1 0.2)" in full


def test_help_names_what_must_be_given_and_how_a_switch_is_turned_off():
    needed, on = Option(("--to",), "FILE", "Where.", required=True), Option(("--log", "--no-log"), "", "Log.", "on")
    command = Command("about", {}, (Option((), "FROM", "What.", required=True), Option((), "AS", "How."), needed, on))
    shown = show("x", command).splitlines()
    assert shown[0] == "usage: cotap x FROM [AS] --to FILE [options]"
    assert f"  {'--to FILE':27s}Where. (required)" in shown
    assert f"  {'--[no-]log':27s}Log. (on)" in shown


@pytest.mark.parametrize("name", COMMANDS)
def test_first_sentences_of_options_take_two_lines_at_most(name: str):
    for option in COMMANDS[name].options:
        if not option.group:
            lines = show(name, Command("about", {}, (option,))).splitlines()[5:-2]
            assert len(lines) <= 2, "\n".join(lines)


@pytest.mark.parametrize(
    "name", ["train", "train base", "train distill", "evaluate tour", "export", "play", "motions import"]
)
def test_every_command_that_has_a_default_robot_takes_another(name: str):
    assert any("--robot" in option.flags for option in COMMANDS[name].options)


def test_a_name_that_resembles_nothing_gets_the_list():
    assert unknown("law", "zzz", ["pd", "cotap"]) == "unknown law 'zzz'; known: pd, cotap"
    assert len(unknown("law", "z" * 10**6, ["pd"])) < 200


@pytest.mark.parametrize(
    ("command", "work", "arguments"),
    [
        ("evaluate", "cotap.evaluate.run", ["impact"]),
        ("export", "cotap.deployment.graph.export_policy", ["--output", "p.onnx"]),
        ("compare", "cotap.compare.read", ["a.json", "b.json"]),
        ("motions", "cotap.motions.__main__.describe", ["show"]),
        ("deploy", "cotap.deploy.deploy", ["--policy", "p.onnx"]),
        ("train", "cotap.train.train_both", []),
        ("play", "cotap.play.__main__._run", []),
    ],
)
@pytest.mark.usefixtures("in_tmp_path")
def test_an_interrupted_command_ends_without_a_traceback(command, work, arguments, monkeypatch, capsys):
    def interrupted(*_args, **_options):
        raise KeyboardInterrupt

    module = importlib.import_module(
        f"cotap.{command}.__main__" if command in ("motions", "play") else f"cotap.{command}"
    )
    monkeypatch.setattr(work, interrupted)
    assert module.main(arguments) == (0 if command == "play" else 130)  # which only that can end
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("name", ["train", "evaluate", "deploy"])
def test_a_usage_message_loads_no_compiler_and_no_library_that_it_does_not_need(name):
    heavy = "{'torch._dynamo', 'sympy', 'scipy', 'matplotlib'}"
    code = f"import sys, cotap.{name}; print(*sorted({heavy} & sys.modules.keys()))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout.strip() == ""


def test_a_reader_that_leaves_early_gets_no_traceback():
    """As `cotap --help | head -1` does, here before anything is written."""
    read, write = os.pipe()
    os.close(read)
    ended = subprocess.run([sys.executable, "-m", "cotap", "--help"], stdout=write, stderr=subprocess.PIPE, check=False)
    os.close(write)
    assert (ended.returncode, ended.stderr) == (1, b"")
