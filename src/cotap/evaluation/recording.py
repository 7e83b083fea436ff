"""Recordings of what happened on the page of `cotap.play`: one file to measure and to show again."""

from __future__ import annotations

import io
import json
import math
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from cotap.checks import require_range
from cotap.evaluation.disturbance import response_measures, window_measures
from cotap.evaluation.metrics import summarize, tracking_measures
from cotap.evaluation.rollout import STEPPED, Trajectory
from cotap.files import write_atomically

FORMAT, VERSION = "cotap-recording", 1
SCENE = {
    "qpos": 1, "hand_w": 2, "hand_reference_w": 2, "hand_force_w": 2, "heading_w": 2, "commanded_stiffness": 2,
    "effective_stiffness": 3, "stiffness_eigenvalues": 2,
}  # fmt: skip
"""What is shown beside the trajectory, and the number of dimensions after (T, N)."""
MAX_BYTES = 4 << 30
"""Largest size of a recording's arrays; an hour of two robots takes half of it."""


class RecordingError(ValueError):
    """A file that cannot be used as a recording; the message names it and says why."""


@dataclass(frozen=True)
class Recording:
    """T control steps of N robots that stood side by side."""

    trajectory: Trajectory
    scene: dict[str, np.ndarray]
    """By the names in `SCENE`, (T, N, ...) each: robots' `qpos`; hands, their references and the forces on them, world
    frame [m, N]; heading frames; commanded (diagonal; NaN where a law commands none) and effective hand stiffness in
    the heading frame [N/m]; smallest and largest eigenvalue of the arms' joint stiffness [Nm/rad]."""
    settings: dict[str, Any]
    """What is not in the arrays: robot, hands, gait period, and the page's settings as they changed."""

    def save(self, path: Path) -> None:
        """Write to `path` (.npz), whole or not at all."""
        arrays = {f"trajectory.{name}": getattr(self.trajectory, name) for name in ("dt", *STEPPED)}
        arrays |= {f"scene.{name}": value for name, value in self.scene.items()}
        arrays["head"] = json.dumps({"format": FORMAT, "version": VERSION, "settings": self.settings})

        def write(temporary: Path) -> None:
            with temporary.open("wb") as file:
                np.savez_compressed(file, allow_pickle=False, **{k: np.asarray(v) for k, v in arrays.items()})

        write_atomically(path, write)


def load_recording(path: Path | str) -> Recording:
    """Read a recording, without running any code from the file.

    Raises:
        RecordingError: the file is missing, truncated, foreign, of another version, or its arrays do not fit together.
    """
    path = Path(path)
    if not path.is_file():
        raise RecordingError(f"recording {str(path)!r} does not exist")
    try:
        arrays = _read(path)
        head = json.loads(str(arrays.pop("head")))
        kind, version = head["format"], head["version"]
        settings = head["settings"]
    except (OSError, ValueError, LookupError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise RecordingError(f"{str(path)!r} is not a cotap recording, or is truncated: {error}") from error
    if kind != FORMAT or version != VERSION:
        raise RecordingError(f"{str(path)!r} is a {kind!r} of version {version!r}; this cotap reads {FORMAT} {VERSION}")
    return _assemble(path, arrays, settings)


def _read(path: Path) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(path) as archive:
        size = sum(info.file_size for info in archive.infolist())
        if size > MAX_BYTES:
            raise ValueError(f"its arrays take {size} bytes; at most {MAX_BYTES} are read")
        return {
            info.filename.removesuffix(".npy"): np.load(io.BytesIO(archive.read(info)), allow_pickle=False)
            for info in archive.infolist()
        }


def _assemble(path: Path, arrays: dict[str, np.ndarray], settings: Any) -> Recording:
    names = [f"trajectory.{name}" for name in ("dt", *STEPPED)] + [f"scene.{name}" for name in SCENE]
    missing = [name for name in names if name not in arrays]
    if missing:
        raise RecordingError(f"recording {str(path)!r} lacks {missing[0]!r}")
    if not isinstance(settings, dict):
        raise RecordingError(f"recording {str(path)!r} has no settings")
    steps = arrays["trajectory.fell"].shape
    if len(steps) != 2 or 0 in steps:
        raise RecordingError(f"recording {str(path)!r} has no steps: trajectory.fell has shape {steps}")
    for name in names:
        value = arrays[name]
        if name != "trajectory.dt" and value.shape[:2] != steps:
            raise RecordingError(f"recording {str(path)!r}: {name} has shape {value.shape}, not {steps} and more")
        if value.dtype.kind not in "fb":
            raise RecordingError(f"recording {str(path)!r}: {name} holds {value.dtype}, not numbers")
    dt = float(arrays["trajectory.dt"])
    if not (math.isfinite(dt) and 0.0 < dt <= 1.0):
        raise RecordingError(f"recording {str(path)!r}: dt must lie in (0, 1] s, got {dt}")
    for name, dimensions in SCENE.items():
        value = arrays[f"scene.{name}"]
        if value.ndim != 2 + dimensions:
            raise RecordingError(f"recording {str(path)!r}: scene.{name} has shape {value.shape}")
        if name != "commanded_stiffness" and not np.isfinite(value).all():
            raise RecordingError(f"recording {str(path)!r}: scene.{name} has values that are not finite")
    tensors = {name: torch.from_numpy(arrays[f"trajectory.{name}"]) for name in STEPPED}
    return Recording(Trajectory(dt=dt, **tensors), {name: arrays[f"scene.{name}"] for name in SCENE}, settings)


@dataclass
class RecordingProtocol:
    """What of a recording is measured."""

    file: str = ""
    """The recording (.npz)."""
    window_seconds: float = 1.0
    """How long after the first force on a hand that force's effects are measured [s]."""
    settle_seconds: float = 1.0
    """Velocity errors are measured once a command has held for this long [s]."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        if not self.file:
            raise ValueError("--file must name a recording")
        require_range("window_seconds", self.window_seconds, 0.02, 3600.0)
        require_range("settle_seconds", self.settle_seconds, 0.0, 3600.0)


def first_force(recording: Recording) -> tuple[float, str] | None:
    """When, in seconds from the start, a hand was first loaded, and which: left, right or both; None if none was."""
    loaded = np.abs(recording.scene["hand_force_w"]).max((1, 3)) > 1e-6  # (T, H)
    if not loaded.any():
        return None
    step = int(loaded.any(1).argmax())
    hands = [side for side, on in zip(recording.settings["sides"], loaded[step], strict=True) if on]
    return step * recording.trajectory.dt, hands[0] if len(hands) == 1 else "both"


def measure(recording: Recording, protocol: RecordingProtocol) -> dict[str, Any]:
    """The measured part of the evaluation's JSON: over the whole recording, and after the first force on a hand.

    `robots` has every measure of every robot; a robot counts up to its first fall.
    """
    t = recording.trajectory
    steps, count = t.fell.shape
    measures = tracking_measures(t, float(recording.settings["gait_period_s"]), protocol.settle_seconds)
    window = {"start": 0.0, "end": steps * t.dt}
    loaded = first_force(recording)
    # Half a second of quiet before, so that there is something to recover to.
    if loaded and 0.5 <= loaded[0] <= steps * t.dt - protocol.window_seconds:
        sides = recording.settings["sides"]
        hit = [i for i, side in enumerate(sides) if loaded[1] in (side, "both")]
        onset = round(loaded[0] / t.dt)
        end = onset + round(protocol.window_seconds / t.dt)
        after = window_measures(t, onset, end, hit) | response_measures(t, onset, onset, end, hit)
        measures |= {f"force_{name}": value for name, value in after.items()}
        window |= {"force_start": loaded[0], "force_end": loaded[0] + protocol.window_seconds}
    stood = ~t.fell.any(0)
    return {
        "num_envs": count,
        "num_falls": int((~stood).sum()),
        "metrics": {name: summarize(value) for name, value in measures.items()},
        "metrics_without_falls": {name: summarize(value[stood]) for name, value in measures.items()},
        "robots": [
            {name: None if math.isnan(value[i]) else float(value[i]) for name, value in measures.items()}
            for i in range(count)
        ],
        "window": window,
    }
