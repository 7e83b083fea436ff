"""Make the motion library that the package ships, from the DeepMimic clips in the `pybullet` package's data.

python -m pip install pybullet
python -m release.build_motion_library [FOLDER] [--robot NAME]
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import cotap
from cotap.motions.importer import ImportResult, import_motions, table
from cotap.motions.library import MotionClip, MotionError, MotionLibrary
from cotap.motions.processing import mirror_clip
from cotap.robots import ROBOTS

SOURCE = "DeepMimic (Peng et al., 2018), by way of the pybullet package's data: {file}"
LICENCE = "MIT"


def installed_folder() -> Path:
    """Where the installed pybullet_data keeps its motions."""
    found = find_spec("pybullet_data")
    if found is None or found.origin is None:
        raise SystemExit("error: pybullet is not installed here; install it, or name the folder of its motions")
    return Path(found.origin).parent / "data" / "motions"


def short_name(name: str) -> str:
    """`humanoid3d_dance_a` to `dance_a`, `0walk_forward` to `walk_forward`."""
    return name.removeprefix("humanoid3d_").lstrip("0123456789")


def main() -> int:
    """Import, mirror, name, save, and print the table of quality."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, help="pybullet_data/data/motions; by default the installed one")
    parser.add_argument("--robot", default="h1", choices=sorted(ROBOTS))
    options = parser.parse_args()
    spec = ROBOTS[options.robot]()
    try:
        result = import_motions([options.folder or installed_folder()], spec, "deepmimic")
    except MotionError as error:
        parser.error(str(error))
    named = [
        replace(c, name=short_name(c.name), source=SOURCE.format(file=f"{c.name}.txt"), licence=LICENCE)
        for c in result.clips
    ]
    clips: list[MotionClip] = [clip for c in named for clip in (c, mirror_clip(spec, c))]
    path = Path(cotap.__file__).parent / "motions" / f"{spec.name}_motions.npz"
    MotionLibrary(clips, spec).save(path)
    print(table(ImportResult(clips, result.quality, [c.name for c in named], result.failures)))
    print(f"\nwritten: {path}, {path.stat().st_size / 1024:.0f} KiB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
