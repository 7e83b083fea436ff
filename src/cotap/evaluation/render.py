"""Pictures and videos of recorded motion."""

from __future__ import annotations

# MuJoCo's extension module has no type stubs.
# pyright: reportAttributeAccessIssue=false
from collections.abc import Callable, Iterator
from pathlib import Path

import mujoco
import numpy as np
import torch
from tqdm import tqdm

from cotap.checks import reason_of
from cotap.envs import HumanoidEnv
from cotap.evaluation.ray_renderer import RayRenderer
from cotap.files import write_atomically
from cotap.robots import RobotSpec
from cotap.robots.mjcf import build_model

STRIDE = 2
"""Control steps from one picture of a film to the next."""


def render_frames(
    spec: RobotSpec, qpos: torch.Tensor, width: int = 640, height: int = 480, camera: str = "track"
) -> Iterator[np.ndarray]:
    """Images (height, width, 3) uint8 of the configurations `qpos` (T, nq)."""
    model = build_model(spec)
    data = mujoco.MjData(model)
    renderer = RayRenderer(model, height, width)
    for row in qpos.numpy():
        data.qpos[:] = row
        mujoco.mj_forward(model, data)
        renderer.update_scene(data, camera)
        yield renderer.render()


Rgba = tuple[float, float, float, float]
REFERENCE_RGBA = (0.15, 0.35, 0.9, 1.0)
FORCE_RGBA = (0.85, 0.1, 0.1, 1.0)
FORCE_SCALE_M_PER_N = 0.006
LONGEST_ARROW_M = 0.8


Mark = Callable[[mujoco.MjvScene, mujoco.MjData, int], None]
"""Adds to the scene of a picture, of this number, what is to be seen beside the robot."""


def film_frames(
    env: HumanoidEnv, film: torch.Tensor, width: int = 640, height: int = 480, camera: str = "track",
    mark: Mark | None = None,
) -> Iterator[np.ndarray]:  # fmt: skip
    """Images (height, width, 3) uint8 of a film (T, nq + 6 H) of `record_rollout`.

    Blue balls are the hands' references, red arrows the forces, which point at the hands.
    """
    model = build_model(env.spec, unevenness_m=env.cfg.unevenness_m)
    data = mujoco.MjData(model)
    sides = [arm.side for arm in env.spec.arms]
    renderer = RayRenderer(model, height, width)
    for number, row in enumerate(film.double().numpy()):
        data.qpos[:] = row[: model.nq]
        mujoco.mj_forward(model, data)
        renderer.update_scene(data, camera)
        points, forces = row[model.nq :].reshape(2, len(sides), 3)
        for side, point, force in zip(sides, points, forces, strict=True):
            add_ball(renderer.scene, point, REFERENCE_RGBA)
            if np.linalg.norm(force) > 0.0:
                add_force(renderer.scene, data.site(f"{side}_hand").xpos, force)
        if mark:
            mark(renderer.scene, data, number)
        yield renderer.render()


def add_ball(scene: mujoco.MjvScene, center: np.ndarray, rgba: Rgba, radius_m: float = 0.035) -> None:
    """Draw a ball at `center` (3,) [m]."""
    scene.ngeom += 1
    mujoco.mjv_initGeom(
        scene.geoms[scene.ngeom - 1], mujoco.mjtGeom.mjGEOM_SPHERE, np.full(3, radius_m), center, np.eye(3).ravel(),
        np.array(rgba, dtype=np.float32),
    )  # fmt: skip


def add_arrow(scene: mujoco.MjvScene, tail: np.ndarray, tip: np.ndarray, rgba: Rgba) -> None:
    """Draw an arrow from `tail` (3,) to `tip` (3,) [m]."""
    scene.ngeom += 1
    geom = scene.geoms[scene.ngeom - 1]
    mujoco.mjv_initGeom(
        geom, mujoco.mjtGeom.mjGEOM_ARROW, np.zeros(3), np.zeros(3), np.eye(3).ravel(),
        np.array(rgba, dtype=np.float32),
    )  # fmt: skip
    mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_ARROW, 0.02, tail, tip)


def add_force(scene: mujoco.MjvScene, point: np.ndarray, force: np.ndarray) -> None:
    """Draw a force (3,) [N] as an arrow that ends at the `point` (3,) [m] that it acts at."""
    size = float(np.linalg.norm(force))
    tail = point - force / size * min(FORCE_SCALE_M_PER_N * size, LONGEST_ARROW_M)
    add_arrow(scene, tail, point, FORCE_RGBA)


def film_video(
    path: Path, env: HumanoidEnv, film: torch.Tensor, sheet: Path | None = None, mark: Mark | None = None
) -> None:
    """Write a video (and a contact sheet) of a film; picture k is of its row `STRIDE` k."""
    part = film[::STRIDE]
    write_film(path, film_frames(env, part, mark=mark), len(part), env.dt, sheet)


def write_film(path: Path, frames: Iterator[np.ndarray], count: int, dt: float, sheet: Path | None = None) -> None:
    """Write a video of `count` frames, one for every `STRIDE` control steps of `dt` [s], and a contact sheet; shows
    how far it is."""
    drawn = list(tqdm(frames, desc="filming", total=count, unit="frame", disable=None, leave=False))
    write_video(path, iter(drawn), 1.0 / (dt * STRIDE))
    if sheet is not None:
        contact_sheet(sheet, drawn[:: max(1, len(drawn) // 24)][:24], 6)


def write_video(path: Path, frames: Iterator[np.ndarray], fps: float) -> None:
    """Write frames as MP4, atomically. Raises OSError if it cannot be written."""
    import imageio.v2 as imageio

    def write(temporary: Path) -> None:
        with imageio.get_writer(temporary, format="FFMPEG", fps=fps, macro_block_size=8, quality=7) as writer:  # pyright: ignore
            for frame in frames:
                try:
                    writer.append_data(frame)
                except OSError as error:  # imageio adds all that ffmpeg was told
                    raise OSError(f"cannot write film {path}: ffmpeg stopped ({reason_of(error)})") from error
        if "moov" not in mp4_boxes(temporary):  # ffmpeg is another program, and imageio does not say that it failed
            raise OSError(f"cannot write film {path}: ffmpeg did not finish it (disk full?)")

    write_atomically(path, write)


def mp4_boxes(path: Path) -> list[str]:
    """The parts of a file as MP4 names them, as far as they are whole; a film that can be played has a `moov`."""
    names, left = [], path.stat().st_size
    with path.open("rb") as file:
        while len(head := file.read(8)) == 8:
            size = int.from_bytes(head[:4], "big")
            read = 8
            if size == 1:  # a longer one
                size, read = int.from_bytes(file.read(8), "big"), 16
            if size < read or size > left:
                break
            names.append(head[4:].decode("latin-1"))
            file.seek(size - read, 1)
            left -= size
    return names


def contact_sheet(path: Path, frames: list[np.ndarray], columns: int) -> None:
    """Write frames as one PNG, row by row."""
    import imageio.v2 as imageio

    blank = np.full_like(frames[0], 255)
    padded = frames + [blank] * (-len(frames) % columns)
    rows = [np.concatenate(padded[i : i + columns], 1) for i in range(0, len(padded), columns)]
    write_atomically(path, lambda p: imageio.imwrite(p, np.concatenate(rows, 0), format="png"))  # pyright: ignore
