"""`cotap motions import|show`: motion data in, and to look at."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from cotap.checks import shortened
from cotap.files import require_output
from cotap.motions.formats import FORMATS
from cotap.motions.importer import describe, import_motions, table
from cotap.motions.library import MotionError, MotionLibrary, shipped_library
from cotap.robots import ROBOTS


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="cotap motions", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    importer = commands.add_parser("import", description="Read motion files of any known format into one library.")
    importer.add_argument("sources", nargs="+", type=Path, metavar="SOURCE", help="files, or folders to search")
    importer.add_argument("--format", default="auto", choices=("auto", *FORMATS), help="format of the files")
    importer.add_argument(
        "--output",
        type=Path,
        required=True,
        metavar="FILE",
        help="the library to write (.npz); one of that name is replaced",
    )
    importer.add_argument("--mirror", action="store_true", help="add the left-right mirror image of every clip")
    importer.add_argument("--fps", type=float, metavar="HZ", help="frame rate of the files, in place of what they say")
    importer.add_argument("--source", default="not stated", help="where the motion comes from, kept in the file")
    importer.add_argument("--licence", default="not stated", help="its terms, kept in the file")
    shower = commands.add_parser("show", description="List a library's clips, and draw them if asked to.")
    shower.add_argument("file", nargs="?", type=Path, metavar="FILE", help="a library; by default the shipped one")
    shower.add_argument("--clip", action="append", default=[], help="only this clip (may be repeated)")
    shower.add_argument(
        "--output", type=Path, metavar="DIR", help="draw the clips, seconds for each, and put the pictures here"
    )
    for command in (importer, shower):
        command.add_argument("--robot", default="h1", choices=tuple(ROBOTS), help="whose arms they move")
    return parser


def _import(options: argparse.Namespace) -> int:
    if options.output.suffix != ".npz":
        raise MotionError(f"--output must end in .npz, got {str(options.output)!r}")
    options.output.parent.mkdir(parents=True, exist_ok=True)
    require_output("--output", options.output)
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
    options = make_parser().parse_args(arguments)
    try:
        return {"import": _import, "show": _show}[options.command](options)
    except (ValueError, OSError) as error:
        print(f"error: {shortened(str(error))}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
