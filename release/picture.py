"""Make README's moving picture: the same load on the hand of a robot that walks, once soft and once stiff.

python -m release.picture --output docs/load.webp
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from PIL import Image, ImageDraw, ImageFont

from cotap.checks import reason_of, require_range
from cotap.evaluate import pictures
from cotap.files import require_output, write_atomically

SECONDS, ONSET_S, LOAD_S = 3.5, 1.0, 1.5
SIZE, WIDTH = 480, 300  # [pixels] of what is drawn, and of the middle that is kept
MARGIN = 0.08  # of the height, above and below


@dataclass
class Options:
    """README's moving picture."""

    output: str = "docs/load.webp"
    """Where to write it (.webp)."""
    force: float = 40.0
    """Down on the left hand [N]."""
    stiffness: tuple[float, float] = (200.0, 800.0)
    """Of the hands, left and right picture [N/m]."""
    checkpoint: str = "h1-cotap"
    """Path of a checkpoint, or the name of one that is shipped."""
    frames_per_second: int = 15
    """Of the film."""


def main(argv: list[str] | None = None) -> int:
    """Write the picture. Exit status."""
    options = tyro.cli(Options, args=argv, prog="python -m release.picture", description=Options.__doc__)
    try:
        require_output("--output", options.output, (".webp",))
        require_range("frames_per_second", options.frames_per_second, 1, 50)
        films = [film(options, stiffness) for stiffness in options.stiffness]
    except (OSError, ValueError) as error:
        print(f"error: {reason_of(error)}", file=sys.stderr)
        return 2
    frames = [Image.fromarray(np.concatenate(pair, 1)) for pair in zip(*films, strict=True)]
    pause = round(1000 / options.frames_per_second)
    write_atomically(
        Path(options.output),
        lambda path: frames[0].save(
            path, "WEBP", save_all=True, append_images=frames[1:], duration=pause, loop=0, quality=70, method=6
        ),
    )
    return 0


def film(options: Options, stiffness: float) -> list[np.ndarray]:
    """Pictures (height, WIDTH, 3) of a robot whose hands have this stiffness [N/m]."""
    args = ["impact", "--checkpoint", options.checkpoint, "--num-envs", "1", "--mode", "walking", "--method", "cotap"]
    args += ["--stiffness", str(stiffness), "--motion", "none", "--force", "0", "0", str(-options.force)]
    args += ["--onset", str(ONSET_S), "--duration", str(LOAD_S), "--episode-seconds", str(ONSET_S + 3.0)]
    times = np.arange(0.0, SECONDS, 1.0 / options.frames_per_second)
    left, top = (SIZE - WIDTH) // 2, round(MARGIN * SIZE)
    shown, fell_s = pictures(args, tuple(times), SIZE, SIZE)
    if fell_s < SECONDS:
        raise ValueError(f"the robot fell after {fell_s:.2f} s at {stiffness:g} N/m: nothing to show")
    kept = [p[top:-top, left : left + WIDTH] for p in shown]
    return [label(p, f"{stiffness:g} N/m", loaded(t, options.force)) for p, t in zip(kept, times, strict=True)]


def loaded(time: float, force: float) -> str:
    """What is on the hand at this time [s]."""
    return f"{force:g} N on the left hand" if ONSET_S <= time < ONSET_S + LOAD_S else ""


def label(picture: np.ndarray, *lines: str) -> np.ndarray:
    """`picture` with lines of text in its upper left corner."""
    image = Image.fromarray(picture)
    for row, text in enumerate(lines):
        ImageDraw.Draw(image).text((12, 10 + 26 * row), text, fill=(20, 20, 20), font=ImageFont.load_default(20))
    return np.asarray(image)


if __name__ == "__main__":
    sys.exit(main())
