"""The command `cotap`: finds out what is asked for, answers questions at once, and hands all else to its module."""

from __future__ import annotations

import importlib
import os
import sys

from cotap.command_help import Command, load_commands, show, unknown

_HELP = ("-h", "--help", "--help-all")
_EXTRAS = {"play": "play", "export": "deploy", "deploy": "deploy"}
"""What a command needs beside the base installation, where it is not `train`."""


def main(argv: list[str] | None = None) -> int:
    """Run a command. Returns the exit status: 0, 2 for bad input, 1 if nobody reads on, or the command's own."""
    try:
        status = _answer(argv)
        sys.stdout.flush()
    except BrokenPipeError:  # as of `| head`; what is left to be written at the end goes nowhere
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return status


def _answer(argv: list[str] | None) -> int:
    args = list(sys.argv[1:] if argv is None else argv)
    commands = load_commands()
    name, rest = _named(args, commands)
    command = commands[name]
    if name != "train" and command.parts:  # all others need a name that is not there
        if rest and rest[0] not in _HELP:
            what = "protocol" if name == "evaluate" else "command"
            print(f"error: {unknown(what, rest[0], list(command.parts))}", file=sys.stderr)
            return 2
        print(show(name, command))
        return 0 if rest or not name else 2
    if name == "train" and rest and not rest[0].startswith("-"):
        print(f"error: {unknown('stage', rest[0], list(command.parts))}", file=sys.stderr)
        return 2
    if len(rest) == 1 and rest[0] in _HELP:
        print(show(name, command, everything=rest[0] == "--help-all"))
        return 0
    if strange := _first_unknown(rest, command):
        print(f"error: cotap {name}: {unknown('option', strange, command.flags())}", file=sys.stderr)
        return 2
    return _run(args)


def _named(args: list[str], commands: dict[str, Command]) -> tuple[str, list[str]]:
    """The longest name of a command that the arguments begin with, and what follows it."""
    for count in (2, 1):
        if (name := " ".join(args[:count])) in commands and len(args) >= count:
            return name, args[count:]
    return "", args


def _first_unknown(args: list[str], command: Command) -> str:
    """The first option that the command does not have, as it was typed; empty if there is none."""
    known = {*command.flags(), *_HELP}
    for arg in args:
        option = arg.partition("=")[0]
        if option.startswith("--") and len(option) > 2 and option.replace("_", "-") not in known:
            return option
    return ""


def _run(args: list[str]) -> int:
    """Hand over to the module of the command. Its packages may be missing: the base installation has torch alone."""
    try:
        module = importlib.import_module(f"cotap.{args[0]}")
        if not hasattr(module, "main"):  # a package
            module = importlib.import_module(f"cotap.{args[0]}.__main__")
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] == "cotap":
            raise
        extra = _EXTRAS.get(args[0], "train")
        print(
            f"error: cotap {args[0]} needs {error.name}: in cotap's folder, pip install -e '.[{extra}]'",
            file=sys.stderr,
        )
        return 2
    return module.main(args[1:])


if __name__ == "__main__":
    sys.exit(main())
