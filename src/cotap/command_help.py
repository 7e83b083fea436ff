"""Help of all commands, from a file that is made of their parsers: nothing heavy is imported to answer a question."""

from __future__ import annotations

import difflib
import json
import re
import textwrap
from dataclasses import asdict, dataclass, field
from importlib.resources import files

WIDTH = 80
"""Columns of a screen."""
_FIRST, _NARROW = 29, 22
"""Columns of an option's name, and of a command's."""
_JOINT = "\N{NO-BREAK SPACE}"


@dataclass(frozen=True)
class Option:
    """One option of a command."""

    flags: tuple[str, ...]
    """Its names, such as --seed; empty for what is given without one."""
    value: str
    """What follows, such as INT."""
    help: str
    """What it does."""
    default: str = ""
    """Its default, as one would type it; empty if it has none."""
    group: str = ""
    """`laws` for the laws of the arms, `config` for a field of a training's config, empty for all else."""
    required: bool = False
    """Whether the command does nothing without it."""

    @property
    def label(self) -> str:
        """Its name and what follows it; for a switch that is on, how to turn it off as well."""
        name = self.flags[0] if self.flags else ""
        if self.default == "on":
            name = f"--[no-]{name[2:]}"
        return f"{name} {self.value}".strip()

    @property
    def note(self) -> str:
        """Its default, or that it must be given."""
        return "required" if self.required and self.flags else self.default


@dataclass(frozen=True)
class Command:
    """One command, or one that others begin with."""

    about: str
    """What it does."""
    parts: dict[str, str] = field(default_factory=dict)
    """Names that may follow, and what each is for."""
    options: tuple[Option, ...] = ()
    """All options, in the order in which they are shown."""

    def flags(self) -> list[str]:
        """Names of all options."""
        return [flag for option in self.options for flag in option.flags]


def load_commands() -> dict[str, Command]:
    """All commands, by names such as `evaluate impact`."""
    content = json.loads(files("cotap").joinpath("command_help.json").read_text(encoding="utf-8"))
    return {
        name: Command(c["about"], c["parts"], tuple(Option(tuple(o.pop("flags")), **o) for o in c["options"]))
        for name, c in content.items()
    }


def dump_commands(commands: dict[str, Command]) -> str:
    """The file's content."""
    return json.dumps({name: asdict(c) for name, c in commands.items()}, indent=1) + "\n"


def show(name: str, command: Command, everything: bool = False) -> str:
    """Help on a command: on one screen, or on every option in full."""
    text = [f"usage: cotap {name}".rstrip() + _usage(command), "", textwrap.fill(command.about, WIDTH)]
    if command.parts:
        text += ["", *(_wrapped(part, about) for part, about in command.parts.items())]
        text += ["", f"Options: cotap {name} NAME --help".replace("  ", " ")]
    options = [o for o in command.options if everything or not o.group]
    if options:
        text += ["", "options:", *(_in_full(o) if everything else _in_short(o) for o in options)]
    if not everything:
        text += _left_out(command)
    return "\n".join(text)


def unknown(what: str, name: str, known: list[str]) -> str:
    """Of a name that is not known, what is meant by it or is allowed."""
    near = difflib.get_close_matches(name, known, 3, 0.5)
    meant = f"did you mean {' or '.join(near)}?" if near else f"known: {', '.join(known[:40])}"
    return f"unknown {what} {name[:100]!r}; {meant}"


def _usage(command: Command) -> str:
    given = "".join(f" {o.label}" if o.required else f" [{o.label}]" for o in command.options if not o.flags)
    needed = "".join(f" {o.label}" for o in command.options if o.flags and o.required)
    return (" NAME" if command.parts and not command.options else given + needed) + " [options]"


def _wrapped(label: str, about: str) -> str:
    indent = " " * _NARROW
    return textwrap.fill(about, WIDTH, initial_indent=f"  {label:{_NARROW - 2}s}", subsequent_indent=indent)


def _in_short(option: Option) -> str:
    """What an option is, in its first sentence: on a line or two beside its name."""
    sentence = re.split(r"(?<=\.)\s", option.help, maxsplit=1)[0]
    joined = option.note.replace(" ", _JOINT)  # stays on one line
    note = f" ({joined})" if 0 < len(joined) <= 16 else ""
    lines = textwrap.wrap(sentence + note, WIDTH - _FIRST, break_on_hyphens=False)
    indent = "\n" + " " * _FIRST
    label = f"  {option.label:{_FIRST - 2}s}"
    return (label + ("" if label.endswith(" ") else indent) + indent.join(lines)).rstrip().replace(_JOINT, " ")


def _in_full(option: Option) -> str:
    names = ", ".join(option.flags)
    note = "" if not option.note else " (required)" if option.note == "required" else f" (default: {option.note})"
    indent = " " * 8
    about = textwrap.fill(
        option.help + note, WIDTH, break_on_hyphens=False, initial_indent=indent, subsequent_indent=indent
    )
    return f"  {names} {option.value}".rstrip() + "\n" + about


def _left_out(command: Command) -> list[str]:
    """What the one screen has no room for."""
    lines = []
    laws = [o.flags[0] for o in command.options if o.group == "laws"]
    if laws:
        lines += [
            "",
            textwrap.fill("laws of the arms: " + " ".join(laws), WIDTH, break_on_hyphens=False, subsequent_indent="  "),
        ]
    fields = sum(o.group == "config" for o in command.options)
    if fields:
        lines += ["", f"And {fields} options for fields of the configuration, such as --ppo.clip."]
    return [*lines, "", "Every option, in full: --help-all"] if command.options else lines
