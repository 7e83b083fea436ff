"""Recordings of what happened on the page of `cotap play`: one file to measure and to show again."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from cotap.checks import quoted, reason_of, require_finite, require_range
from cotap.evaluation.disturbance import response_measures, window_measures
from cotap.evaluation.metrics import outcome, tracking_measures
from cotap.evaluation.rollout import STEPPED, Trajectory
from cotap.files import write_arrays
from cotap.inputs import InputError, read_arrays

FORMAT, VERSION = "cotap-recording", 5
SCENE: dict[str, tuple[str | int, ...]] = {
    "qpos": ("Q",), "hand_w": ("H", 3), "hand_reference_w": ("H", 3), "hand_force_w": ("H", 3), "heading_w": (3, 3),
    "commanded_stiffness": ("H", 3), "effective_stiffness": ("H", 3, 3), "stiffness_eigenvalues": ("H", 2),
    "store_energy": ("H",), "held_back": ("H",),
}  # fmt: skip
"""What is shown beside the trajectory, and its sizes after (T, N); those that a letter stands for are all alike."""
OF_SOME_LAWS = ("commanded_stiffness", "store_energy", "held_back")
"""Of these, what only some laws have; NaN under the others."""
TRAJECTORY: dict[str, tuple[str | int, ...]] = {
    "velocity": (3,), "command": (3,), "stand": (), "height": (), "height_command": (),
    "position": (2,), "arm_error": ("U",), "arm_velocity": ("U",), "arm_torque": ("U",), "torque_share": ("J",),
    "arm_static_torque": ("U",), "hand_offset": ("H", 3), "hand_error": ("H",), "foot_contact": ("F",),
    "foot_speed": ("F",), "foot_height": ("F",), "path_error": (), "fell": (),
}  # fmt: skip
"""The same of the trajectory."""
EVENTS = ("stand", "foot_contact", "fell")
"""Of these, what is true or false; all else is in single precision."""
_LARGEST = 1e12
"""Whatever is larger was measured on no robot, and its square soon is no number."""
_LEVELS = 8
"""How deep settings may be nested; five levels are in use."""
MAX_BYTES = 4 << 30
"""Largest size of a recording's arrays; an hour of two robots takes half of it."""
MAX_STEPS, MAX_ROBOTS = 400_000, 16
"""The page records 30,000 steps of two."""


_ENTRIES = ("head", "trajectory.dt", *(f"trajectory.{n}" for n in STEPPED), *(f"scene.{n}" for n in SCENE))
"""What is in the file."""


class RecordingError(ValueError):
    """A file that cannot be used as a recording; the message names it and says why."""


@dataclass(frozen=True)
class Recording:
    """T control steps of N robots that stood side by side."""

    trajectory: Trajectory
    scene: dict[str, np.ndarray]
    """By the names in `SCENE`, (T, N, ...) each: robots' `qpos`; hands, their references and the forces on them, world
    frame [m, N]; heading frames; commanded (diagonal; NaN where a law commands none) and effective hand stiffness in
    the heading frame [N/m]; smallest and largest eigenvalue of the arms' joint stiffness [Nm/rad]; level of the arms'
    energy stores [J] and share of the last change of stiffness that was held back (NaN where a law has none)."""
    settings: dict[str, Any]
    """What is not in the arrays: robot, hands, gait period, and the page's settings as they changed."""

    def save(self, path: Path) -> None:
        """Write to `path` (.npz), whole or not at all."""
        arrays = {f"trajectory.{name}": getattr(self.trajectory, name) for name in ("dt", *STEPPED)}
        arrays |= {f"scene.{name}": value for name, value in self.scene.items()}
        arrays["head"] = json.dumps({"format": FORMAT, "version": VERSION, "settings": self.settings})
        write_arrays(path, {k: np.asarray(v) for k, v in arrays.items()})


def load_recording(path: Path | str) -> Recording:
    """Read a recording, without running any code from the file.

    Raises:
        RecordingError: the file is missing, truncated, foreign, of another version, or its arrays do not fit together.
    """
    try:
        arrays = read_arrays(path, _ENTRIES, MAX_BYTES)
    except InputError as error:
        raise RecordingError(f"recording {str(path)!r} {error}") from error
    try:
        head = json.loads(str(arrays.pop("head", "{}")))
        kind, version, settings = (head[name] for name in ("format", "version", "settings"))
    except KeyError as error:
        raise RecordingError(f"{str(path)!r} is not a cotap recording: it lacks {error}") from error
    except (ValueError, TypeError, RecursionError) as error:  # no JSON, or none of a table
        raise RecordingError(f"{str(path)!r} is not a cotap recording: {reason_of(error)}") from error
    if kind != FORMAT or version != VERSION:
        raise RecordingError(
            f"{str(path)!r} is a {quoted(kind)} of version {quoted(version)}; this cotap reads {FORMAT} {VERSION}"
        )
    try:
        return _assemble(arrays, settings)
    except ValueError as error:
        raise RecordingError(f"recording {str(path)!r}: {error}") from error


def _assemble(arrays: dict[str, np.ndarray], settings: Any) -> Recording:
    missing = [name for name in _ENTRIES[1:] if name not in arrays]
    if missing:
        raise ValueError(f"it lacks {missing[0]!r}")
    dt = _step(arrays["trajectory.dt"])
    _check_settings(settings, dt)
    sizes = {"H": len(settings["sides"])}
    for name, shape in TRAJECTORY.items():
        value = arrays[f"trajectory.{name}"]
        _check_array(f"trajectory.{name}", value, shape, (np.bool_ if name in EVENTS else np.float32,), sizes)
    for name, shape in SCENE.items():
        value = arrays[f"scene.{name}"]
        _check_array(f"scene.{name}", value, shape, (np.float32, np.float64), sizes)
        if name not in OF_SOME_LAWS and not np.isfinite(value).all():
            raise ValueError(f"scene.{name} has values that are not finite")
    if sizes["T"] > MAX_STEPS or sizes["N"] > MAX_ROBOTS:
        raise ValueError(
            f"it is of {sizes['T']} steps of {sizes['N']} robots; at most {MAX_STEPS} of {MAX_ROBOTS} are read"
        )
    tensors = {name: torch.from_numpy(arrays[f"trajectory.{name}"]) for name in STEPPED}
    return Recording(Trajectory(dt=dt, **tensors), {name: arrays[f"scene.{name}"] for name in SCENE}, settings)


def _step(value: np.ndarray) -> float:
    """The control step [s]."""
    if value.dtype.kind != "f" or value.ndim:
        raise ValueError(f"dt must be one number, got {value.dtype} of shape {value.shape}")
    return require_range("dt", float(value), 1e-4, 1.0)


def _check_array(
    name: str, value: np.ndarray, shape: tuple[str | int, ...], kinds: tuple[type, ...], sizes: dict[str, int]
) -> None:
    """Raise ValueError unless this is (T, N, *shape) of one of `kinds`; adds sizes that are new to `sizes`."""
    if value.dtype not in kinds:
        raise ValueError(f"{name} holds {value.dtype}, not {' or '.join(kind.__name__ for kind in kinds)}")
    full = ("T", "N", *shape)
    wanted = tuple(sizes.setdefault(d, n) if isinstance(d, str) else d for d, n in zip(full, value.shape, strict=False))
    if value.ndim != len(full) or value.shape != wanted or 0 in wanted:
        known = ", ".join(f"{letter} = {size}" for letter, size in sizes.items())
        raise ValueError(f"{name} has shape {value.shape}, not ({', '.join(map(str, full))}) with {known}, none 0")
    if (np.abs(value) > _LARGEST).any():
        raise ValueError(f"{name} has values beyond {_LARGEST:g}")


def _check_settings(settings: Any, dt: float) -> None:
    """Raise ValueError unless these are settings as `Recording` has them."""
    if not isinstance(settings, dict):
        raise ValueError(f"settings must be a table, got {quoted(settings)}")
    _check_plain("settings", settings, _LEVELS)
    sides, robot = settings.get("sides", []), settings.get("robot")
    named = isinstance(sides, list) and all(isinstance(side, str) for side in sides)
    if not named or not 0 < len(sides) == len(set(sides)):
        raise ValueError(f"settings.sides must name the hands, got {quoted(sides)}")
    if not isinstance(robot, str):
        raise ValueError(f"settings.robot must be a name, got {quoted(robot)}")
    require_range("settings.gait_period_s", settings.get("gait_period_s", math.nan), max(dt, 0.1), 10.0)


def _check_plain(name: str, value: Any, levels: int) -> None:
    """Raise ValueError for what cannot be written as JSON again: numbers beyond floats, and nesting without end."""
    if isinstance(value, (dict, list)):
        if levels == 0:
            raise ValueError(f"{name} is nested more than {_LEVELS} deep")
        for inner in value.values() if isinstance(value, dict) else value:
            _check_plain(name, inner, levels - 1)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        require_finite(f"a value in {name}", value)


@dataclass
class RecordingProtocol:
    """A recording of `cotap play`, measured robot by robot; nothing is simulated."""

    file: str = ""
    """The recording (.npz)."""
    window_seconds: float = 1.0
    """Time measured after the first force on a hand [s]."""
    settle_seconds: float = 1.0
    """Time a command must have held to be measured [s]."""

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
    measures = tracking_measures(t, recording.settings["gait_period_s"], protocol.settle_seconds)
    window = {"start": 0.0, "end": steps * t.dt}
    loaded = first_force(recording)
    # Half a second of quiet before, so that there is something to recover to.
    if loaded and 0.5 <= loaded[0] <= steps * t.dt - protocol.window_seconds:
        sides = recording.settings["sides"]
        hit = [i for i, side in enumerate(sides) if loaded[1] in (side, "both")]
        onset = round(loaded[0] / t.dt)
        end = onset + max(1, round(protocol.window_seconds / t.dt))
        after = window_measures(t, onset, end, hit) | response_measures(t, onset, onset, end, hit)
        measures |= {f"force_{name}": value for name, value in after.items()}
        window |= {"force_start": loaded[0], "force_end": loaded[0] + protocol.window_seconds}
    stood = ~t.fell.any(0)
    return {
        "num_envs": count,
        "num_falls": int((~stood).sum()),
        **outcome(measures, stood, seed=0, per_env=False),
        "robots": [
            {name: None if math.isnan(value[i]) else float(value[i]) for name, value in measures.items()}
            for i in range(count)
        ],
        "window": window,
    }
