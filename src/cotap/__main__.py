"""`python -m cotap`: the commands that there are."""

from __future__ import annotations

import sys

COMMANDS = {
    "train": "train a policy: of legs and arms (base), then under compliance (distill)",
    "evaluate": "measure a policy by a protocol",
    "compare": "say what differs between two evaluations, and whether it is better",
    "play": "open a page on which a robot walks, is pushed, and has its stiffness turned",
    "motions": "import motions, or show those of a library",
    "export": "write a policy as one ONNX file",
    "deploy": "run an exported policy on one robot, as on hardware, in an engine",
}
"""Modules that are run, and what each does."""


def main(argv: list[str] | None = None) -> int:
    """Print the commands. Returns the exit status: 0, or 2 for arguments, which it has none of."""
    args = sys.argv[1:] if argv is None else argv
    if args and args[0] not in ("-h", "--help"):
        name = args[0][:100]
        known = f"run python -m cotap.{name}" if name in COMMANDS else f"known: {', '.join(COMMANDS)}"
        print(f"error: python -m cotap takes no command, got {name!r}; {known}", file=sys.stderr)
        return 2
    print("\n".join(["commands:", *(f"  python -m cotap.{name:10s}{what}" for name, what in COMMANDS.items())]))
    print("\nOptions: python -m cotap.COMMAND --help")
    return 0


if __name__ == "__main__":
    sys.exit(main())
