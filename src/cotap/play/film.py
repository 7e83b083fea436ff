"""Recordings as MP4, drawn by a viewer's own browser: what it shows is what is filmed, and nothing else is needed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import viser

from cotap.evaluation.recording import Recording
from cotap.evaluation.render import write_video
from cotap.play.recorder import samples_of
from cotap.play.sample import Sample
from cotap.play.scene import Scene

WIDTH, HEIGHT = 1280, 720
FPS = 25.0
"""About how many pictures a second a film has: a whole number of control steps apart."""
TIMEOUT_S = 30.0
"""A browser that takes longer for one picture has stopped drawing, as one in the background does [s]."""


class FilmError(OSError):
    """The viewer's browser did not draw; the message says what to do."""


def film(client: viser.ClientHandle, scene: Scene, recording: Recording, path: Path) -> None:
    """Write a recording, as `client` sees it from where its camera is, to `path` (MP4). Nobody else may draw meanwhile.

    Raises:
        FilmError: the browser went away or stopped drawing; nothing is written.
        OSError: the file cannot be written.
    """
    dt = recording.trajectory.dt
    stride = max(1, round(1.0 / (FPS * dt)))
    shown, scene.shown = scene.shown, recording.trajectory.fell.shape[1]
    try:
        write_video(path, _pictures(client, scene, samples_of(recording)[::stride]), 1.0 / (dt * stride))
    finally:
        scene.shown = shown


def _pictures(client: viser.ClientHandle, scene: Scene, samples: list[Sample]) -> Iterator[np.ndarray]:
    camera = client.camera
    pose = {"position": camera.position, "wxyz": camera.wxyz, "fov": camera.fov}
    for sample in samples:
        scene.show(sample)
        try:
            yield client.get_render(HEIGHT, WIDTH, timeout=TIMEOUT_S, **pose)[..., :3]
        except (RuntimeError, TimeoutError) as error:
            raise FilmError(f"the browser did not draw ({error}); keep its tab in front while filming") from error
