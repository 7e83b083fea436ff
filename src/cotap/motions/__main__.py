"""`cotap motions import|show`: motion data in, and to look at."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NoReturn

from cotap.checks import shortened
from cotap.files import require_output
from cotap.motions.formats import FORMATS
from cotap.motions.importer import describe, find_files, import_motions, table
from cotap.motions.library import MotionError, MotionLibrary, shipped_library
from cotap.robots import ROBOTS


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in a line, as all commands do."""

    def error(self, message: str) -> NoReturn:
        raise MotionError(f"{message}; {self.prog} --help shows the options")


def make_parser() -> argparse.ArgumentParser:
    """The parser of both commands."""
    parser = _Parser(prog="cotap motions", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    importer = commands.add_parser("import", description="Read motion files of any known format into one library.")
    importer.add_argument("sources", nargs="+", type=Path, metavar="SOURCE", help="Files, or folders to search.")
    importer.add_argument(
        "--output",
        type=Path,
        required=True,
        metavar="FILE",
        help="Library to write (.npz). It replaces one of that name.",
    )
    importer.add_argument(
        "--format", default="auto", choices=("auto", *FORMATS),
        help=f"Format of the files: {', '.join(FORMATS)} or auto. auto looks into each file. (default: auto)",
    )  # fmt: skip
    importer.add_argument(
        "--mirror", action="store_true", help="Add the left-right mirror image of every clip whose own is not there."
    )
    importer.add_argument("--fps", type=float, metavar="HZ", help="Frame rate of the files, in place of what they say.")
    importer.add_argument("--source", default="not stated", help="Where the motion comes from. It is kept in the file.")
    importer.add_argument("--licence", default="not stated", help="Licence of the motion. It is kept in the file.")
    shower = commands.add_parser("show", description="List a library's clips, and draw them if asked to.")
    shower.add_argument("file", nargs="?", type=Path, metavar="FILE", help="Library. By default the shipped one.")
    shower.add_argument("--clip", action="append", default=[], help="Only this clip. May be repeated.")
    shower.add_argument(
        "--output",
        type=Path,
        metavar="DIR",
        help="Folder for a picture of each clip, and of the first 24 in one. Without it, nothing is drawn.",
    )
    for command in (importer, shower):
        arms = "Whose arms they move, such as g1. (default: h1)"
        command.add_argument("--robot", default="h1", choices=tuple(ROBOTS), metavar="ROBOT", help=arms)
    return parser


def _import(options: argparse.Namespace) -> int:
    if options.output.suffix != ".npz":
        raise MotionError(f"--output must end in .npz, got {str(options.output)!r}")
    options.output.parent.mkdir(parents=True, exist_ok=True)
    require_output("--output", options.output)
    if options.output.resolve() in {path.resolve() for path in find_files(options.sources)}:
        raise MotionError(f"--output {str(options.output)!r} is one of the files to be read; write it elsewhere")
    spec = ROBOTS[options.robot]()
    result = import_motions(
        options.sources, spec, options.format, options.mirror, options.source, options.licence, sys.stderr.isatty(),
        options.fps,
    )  # fmt: skip
    print(table(result))
    if not result.clips:
        raise MotionError("no clip could be used; nothing was written")
    MotionLibrary(result.clips, spec).save(options.output)
    print(f"\nwritten: {options.output}")
    return 0


def _show(options: argparse.Namespace) -> int:
    spec = ROBOTS[options.robot]()
    library = MotionLibrary.load(options.file, spec) if options.file else shipped_library(spec)
    if options.clip:
        library = library.select(options.clip, spec)
    print(describe(library))
    if options.output:
        from cotap.motions.show import draw  # plotting loads slowly

        for path in draw(library, spec, options.output):
            print(f"written: {path}")
    return 0


def main(arguments: list[str] | None = None) -> int:
    """Parse and run. Returns the exit status: 0, 2 for what the user can correct, or 130 if interrupted."""
    try:
        options = make_parser().parse_args(arguments)
        return {"import": _import, "show": _show}[options.command](options)
    except (ValueError, OSError) as error:
        print(f"error: {shortened(str(error))}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
