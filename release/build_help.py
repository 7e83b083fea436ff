"""Write src/cotap/command_help.json: what `cotap COMMAND --help` shows, of the parsers that read the command line."""

from __future__ import annotations

import argparse
import inspect
import re
import sys
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import tyro

import cotap
from cotap.command_help import Command, Option, dump_commands
from cotap.compare import CompareOptions
from cotap.configs import BASE_RECIPES, DISTILL_RECIPES
from cotap.deploy import DeployOptions
from cotap.evaluate import PROTOCOLS, RECORDING, Options, RecordingOptions
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.recording import RecordingProtocol
from cotap.export import ExportOptions
from cotap.files import write_atomically
from cotap.motions.__main__ import make_parser
from cotap.pipeline import PipelineOptions
from cotap.play.__main__ import PlayOptions
from cotap.train import SHORTCUTS, BaseOptions, DistillOptions

ABOUT = {
    "train": "train policies: of legs and arms (base), then under compliance (distill)",
    "evaluate": "measure a policy by a protocol",
    "compare": "say what differs between two evaluations, and whether it is better",
    "play": "open a page on which to push a robot and change the stiffness of its hands",
    "motions": "import motions, or show those of a library",
    "export": "write a policy as one ONNX file",
    "deploy": "run an exported policy on one robot, as on hardware, in an engine",
}
"""What each command does, in a line."""
FILE = Path(cotap.__file__).parent / "command_help.json"
_GROUPS = ("", "laws", "config")
_NOTHING = ("''", "None", "()", "")
_OWN = ("--seed", "--threads", "--device")
"""Fields of a training's config that need no look at the rest of it."""


def build() -> dict[str, Command]:
    """All commands."""
    base = BASE_RECIPES["default"]()
    trainings = {
        "base": (BaseOptions, BaseOptions(training=base)),
        "distill": (DistillOptions, DistillOptions(training=DISTILL_RECIPES["default"](base))),
    }
    protocols = {name: (Options[kind], Options(kind(), LawOptions())) for name, kind in PROTOCOLS.items()}
    about = {name: purpose(kind) for name, kind in {**PROTOCOLS, RECORDING: RecordingProtocol}.items()}
    motions = _subparsers(make_parser())
    return {
        "": Command("Compliant whole-body control of humanoids.", ABOUT),
        "train": Command(
            purpose(PipelineOptions), {name: purpose(kind) for name, (kind, _) in trainings.items()},
            options(PipelineOptions, None),
        ),
        **{f"train {n}": Command(purpose(trainings[n][0]), {}, options(*trainings[n])) for n in trainings},
        "evaluate": Command("Measure a policy by a protocol.", about),
        **{f"evaluate {n}": Command(about[n], {}, options(kind, default)) for n, (kind, default) in protocols.items()},
        f"evaluate {RECORDING}": Command(
            about[RECORDING], {}, options(RecordingOptions, RecordingOptions(RecordingProtocol()))
        ),
        "compare": Command(purpose(CompareOptions), {}, options(CompareOptions, None)),
        "play": Command(purpose(PlayOptions), {}, options(PlayOptions, None)),
        "motions": Command(
            "Import motions, or show those of a library.", {n: p.description or "" for n, p in motions.items()}
        ),
        **{f"motions {n}": Command(p.description or "", {}, _of_parser(p)) for n, p in motions.items()},
        "export": Command(purpose(ExportOptions), {}, options(ExportOptions, None)),
        "deploy": Command(purpose(DeployOptions), {}, options(DeployOptions, None)),
    }  # fmt: skip


def purpose(kind: type[Any]) -> str:
    """The first paragraph of a class's docstring, in one line."""
    return " ".join((inspect.getdoc(kind) or "").split("\n\n")[0].split())


def options(kind: Any, default: Any) -> tuple[Option, ...]:
    """The options that a dataclass means."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the parser is deprecated; what it knows has no other door
        parser = tyro.extras.get_parser(kind, **({} if default is None else {"default": default}))
    found = _of_parser(parser)
    if kind in (BaseOptions, DistillOptions):
        target = {flag: option for option in found for flag in option.flags}
        short = [replace(target[full], flags=(s,), group="") for s, full in SHORTCUTS.items()]
        found = (*found[:4], *short, *found[4:])
    return found


def _subparsers(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    (action,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    return action.choices


def _of_parser(parser: argparse.ArgumentParser) -> tuple[Option, ...]:
    actions = [a for a in parser._actions if "-h" not in a.option_strings]
    found = [_option(a) for a in sorted(actions, key=lambda a: _title(a) != "protocol options")]
    return tuple(sorted(found, key=lambda o: (bool(o.flags), _GROUPS.index(o.group))))


def _option(action: argparse.Action) -> Option:
    flags, title = tuple(action.option_strings), _title(action)
    value = "" if action.nargs == 0 or len(flags) == 2 else _value(str(action.metavar or action.dest.upper()))
    text, _, default = " ".join((action.help or "").split()).partition(" (default: ")
    default = default.removesuffix(")")
    if action.nargs == 0 or len(flags) == 2:  # a switch
        default = {"True": "on", "False": ""}.get(default, default)
    dotted = bool(flags) and "." in flags[0] and flags[0] not in _OWN
    group = "laws" if title == "laws options" else "config" if dotted else ""
    if not flags:
        value = f"{action.metavar} ..." if action.nargs == "+" else action.dest.upper()
    text = text.replace(" (required)", "")
    return Option(flags, value, text, "" if default in _NOTHING else default, group, action.required)


def _title(action: argparse.Action) -> str:
    return str(getattr(getattr(action, "container", None), "title", ""))


def _value(metavar: str) -> str:
    """What follows an option, without what no reader needs: `{None}|[FLOAT [FLOAT ...]]` is `FLOAT ...`."""
    plain = metavar.replace("{None}|", "").replace("{None,True,False}", "True|False")
    many = re.fullmatch(r"\{?\[(\S+) \[\1 \.\.\.\]\]\}?", plain)
    return f"{many[1]} ..." if many else plain


def main() -> int:
    """Write the file. Returns the exit status."""
    text = dump_commands(build())
    write_atomically(FILE, lambda p: p.write_text(text, encoding="utf-8"))
    print(f"written: {FILE}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
