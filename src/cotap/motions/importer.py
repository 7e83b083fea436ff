"""Importing files and folders of motion: what can be read is kept, what cannot is reported with the reason."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from cotap.checks import legible
from cotap.motions.formats import FASTEST_FPS, FORMATS, SLOWEST_FPS, SUFFIXES, detect_format
from cotap.motions.library import MotionClip, MotionError, MotionLibrary, check_clip
from cotap.motions.processing import JointMotion, make_clip, mirror_clip
from cotap.motions.quality import ClipQuality, assess, peak_speed, root_peaks
from cotap.robots import RobotSpec

_LONGEST_LABEL = 5000
"""Characters of a file's path and a clip's name."""


@dataclass(frozen=True)
class ImportResult:
    """All that came of an import."""

    clips: list[MotionClip]
    quality: list[ClipQuality]
    """One for each clip that was read; mirror images have none of their own."""
    read: list[str]
    """Names of the clips that were read."""
    failures: list[tuple[str, str]]
    """File or clip, and why it could not be used."""


def find_files(sources: Iterable[Path]) -> list[Path]:
    """The files themselves, and all of known suffix below the folders, sorted; each file once.

    Raises MotionError for a missing one.
    """
    found: list[Path] = []
    for source in sources:
        if source.is_dir():
            found += sorted(p for p in source.rglob("*") if p.suffix.lower() in SUFFIXES and not p.is_dir())
        elif source.exists():
            found.append(source)
        else:
            raise MotionError(f"motion source {str(source)!r} does not exist")
    if not found:
        raise MotionError(f"no motion files there; suffixes looked for in folders: {', '.join(SUFFIXES)}")
    return list({path.resolve(): path for path in reversed(found)}.values())[::-1]


def import_motions(
    sources: Iterable[Path], spec: RobotSpec, file_format: str = "auto", mirror: bool = False,
    source: str = "not stated", licence: str = "not stated", progress: bool = True, fps: float | None = None,
) -> ImportResult:  # fmt: skip
    """Read, retarget and limit every clip of `sources`.

    Args:
        sources: Files and folders.
        spec: The robot.
        file_format: One of `FORMATS`, or auto.
        mirror: Add the left-right mirror image of every clip whose own is not there.
        source: Where the motion comes from, kept with each clip; clips of a motion library keep their own.
        licence: Its terms; likewise.
        progress: Show a progress bar.
        fps: Frame rate [Hz] in place of what the files say.

    Raises:
        MotionError: a source is missing, there are no files, or no clip can have that rate.
    """
    if fps is not None and not SLOWEST_FPS <= fps <= FASTEST_FPS:
        raise MotionError(f"--fps must be in [{SLOWEST_FPS:g}, {FASTEST_FPS:g}] Hz, got {fps}")
    result = ImportResult([], [], [], [])
    taken: set[str] = set()
    for path in tqdm(find_files(sources), desc="import", unit="file", disable=None if progress else True, leave=False):
        for label, outcome in _read_file(path, spec, file_format, fps):
            if isinstance(outcome, str):
                result.failures.append((label, outcome))
                continue
            try:
                made = _make(spec, outcome, source, licence, mirror, taken)
            except (ValueError, MemoryError, np.linalg.LinAlgError) as error:
                result.failures.append((label, str(error)))
                continue
            clips, quality = made
            taken |= {clip.name for clip in clips}
            result.clips.extend(clips)
            result.quality.append(quality)
            result.read.append(clips[0].name)
    return result


def _make(
    spec: RobotSpec, motion: JointMotion, source: str, licence: str, mirror: bool, taken: set[str]
) -> tuple[list[MotionClip], ClipQuality]:
    """A motion's clip, with its mirror image if that is asked for and not there, under names that are free."""
    clip, report = make_clip(spec, motion, source, licence)
    quality = assess(spec, motion, clip, report)
    if motion.clip is not None:
        own = motion.clip
        clip = replace(clip, source=own.source, licence=own.licence, mirrored=own.mirrored)
    clip = _renamed(clip, taken)
    images = [_renamed(mirror_clip(spec, clip), taken | {clip.name})] if mirror and not motion.has_image else []
    for made in (clip, *images):
        check_clip(made, spec)  # names have become longer
    return [clip, *images], quality


def _read_file(
    path: Path, spec: RobotSpec, file_format: str, fps: float | None
) -> Iterator[tuple[str, JointMotion | str]]:
    """Every clip of a file, or in its place why it cannot be read."""
    try:
        reader = FORMATS[detect_format(path) if file_format == "auto" else file_format]
        clips = reader(path, spec, fps)
    except (ValueError, OSError, MemoryError) as error:
        yield str(path), str(error)
        return
    for name, read in clips:
        label = str(path) if len(clips) == 1 else f"{path}:{legible(name)}"
        try:
            yield label, read()
        except (ValueError, OSError, MemoryError) as error:
            yield label, str(error)


def _renamed(clip: MotionClip, taken: set[str]) -> MotionClip:
    """The clip under a name that no other has."""
    name, number = clip.name, 2
    while name in taken:
        name, number = f"{clip.name}_{number}", number + 1
    return replace(clip, name=name)


def table(result: ImportResult) -> str:
    """The clips that were read, their quality, and the failures, as Markdown."""
    rows = [
        "| clip | s | clipped | slowed | peak rad/s | hand path m | direction deg | elbow corr. | near singular "
        "| root m/s | turn rad/s |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, q in zip(result.read, result.quality, strict=True):
        rows.append(
            f"| {name} | {q.seconds:.1f} | {q.clipped_fraction:.1%} | {q.slowed_fraction:.1%} | "
            f"{q.peak_speed_rad_s:.1f} | {q.hand_path_error_m:.3f} | {_or_dash(q.hand_direction_error_deg, '.1f')} | "
            f"{_or_dash(q.elbow_correlation, '.3f')} | {q.singular_fraction:.1%} "
            f"| {q.root_speed_m_s:.2f} | {q.root_turn_rad_s:.1f} |"
        )
    minutes = sum(c.seconds for c in result.clips) / 60.0
    out = [*rows, "", f"{len(result.clips)} clips ({len(result.read)} read), {minutes:.1f} minutes"]
    if result.failures:
        out += ["", f"{len(result.failures)} could not be used:"]
        out += [f"- {legible(label, _LONGEST_LABEL)}: {reason}" for label, reason in result.failures]
    return "\n".join(out)


def describe(library: MotionLibrary) -> str:
    """Every clip of a library with what its root and joints do at most, its source and licence, as Markdown."""
    rows = ["| clip | s | peak rad/s | root m/s | turn rad/s | source | licence |", "|---|---|---|---|---|---|---|"]
    for c in library.clips:
        speed, turn = root_peaks(c)
        about = " | ".join(legible(text) for text in (c.source, c.licence))
        rows.append(f"| {c.name} | {c.seconds:.2f} | {peak_speed(c):.1f} | {speed:.2f} | {turn:.1f} | {about} |")
    return "\n".join(rows)


def _or_dash(value: float, form: str) -> str:
    return "-" if np.isnan(value) else format(value, form)
