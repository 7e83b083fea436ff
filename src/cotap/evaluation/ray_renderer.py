"""Pictures that need no OpenGL: a ray per pixel, which MuJoCo follows on the CPU."""

from __future__ import annotations

# MuJoCo's extension module has no type stubs.
# pyright: reportAttributeAccessIssue=false
import mujoco
import numpy as np

_SHOWN_GROUPS = np.array([1, 1, 1, 0, 0, 0], dtype=np.uint8)
"""The groups of geoms that MuJoCo's own renderer shows by default."""
_FARTHEST_M = 50.0
"""Where everything is lost in haze."""
_LAMP_M = 30.0
_SKY = np.array([[0.86, 0.90, 0.95], [0.75, 0.82, 0.90]])
"""At the horizon and overhead."""
_SHADE = 0.35
"""What is left of the lamp's light in a shadow."""


class RayRenderer:
    """Draws a robot on its floor, and the balls and arrows that are added to `scene`.

    Its methods are those of `mujoco.Renderer`, as far as this package uses them.

    Args:
        model: What is drawn. Its last light is the lamp, which shines from afar.
        height, width: [pixels].
    """

    def __init__(self, model: mujoco.MjModel, height: int, width: int) -> None:
        self._model, self._shape = model, (height, width)
        self.scene = mujoco.MjvScene(model, 1000)
        self._option, self._camera = mujoco.MjvOption(), mujoco.MjvCamera()
        self._data = mujoco.MjData(model)
        shown = _SHOWN_GROUPS[model.geom_group] > 0
        self._parts = np.flatnonzero(shown & (model.geom_bodyid > 0))
        ground = np.flatnonzero(shown & (model.geom_bodyid == 0))
        self._floor = -1  # the geom that is a level floor at height 0, if there is nothing else that stands still
        if len(ground) == 1 and model.geom_type[ground[0]] == mujoco.mjtGeom.mjGEOM_PLANE:
            self._floor = int(ground[0])

    def update_scene(self, data: mujoco.MjData, camera: str) -> None:
        """Take the configuration of `data`, seen from the camera of this name."""
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._camera.fixedcamid = self._model.camera(camera).id
        mujoco.mjv_updateScene(
            self._model, data, self._option, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL, self.scene
        )
        self.scene.ngeom = 0  # rays find the model's own
        self._data = data

    def render(self) -> np.ndarray:
        """The picture (height, width, 3) uint8."""
        eye, rays = self._rays()
        geom, distance, normal = self._cast(eye, rays)
        color, lit = np.zeros((len(rays), 3)), np.zeros(len(rays))
        hit = geom >= 0
        points = eye + distance[hit, None] * rays[hit]
        color[hit], lit[hit] = self._surface(geom[hit], points), self._lit(points, normal[hit])
        for mark in self.scene.geoms[: self.scene.ngeom]:
            for ball in _balls(mark):
                seen, at, direction = _meet(ball, eye, rays, distance)
                distance[seen], normal[seen], color[seen] = at, direction, mark.rgba[:3]
                lit[seen] = np.maximum(0.0, direction @ self._to_lamp)
        head = self._model.vis.headlight
        facing = np.maximum(0.0, -(normal * rays).sum(1))[:, None]
        light = head.ambient + head.diffuse * facing + self._model.light_diffuse[-1] * lit[:, None]
        up, haze = np.clip(rays[:, 2:], 0.0, 1.0), np.square(distance / _FARTHEST_M)[:, None]
        picture = (1.0 - haze) * color * light + haze * ((1.0 - up) * _SKY[0] + up * _SKY[1])
        return (255.0 * np.clip(picture, 0.0, 1.0)).astype(np.uint8).reshape(*self._shape, 3)

    @property
    def _to_lamp(self) -> np.ndarray:
        return -_unit(self._data.light_xdir[-1])

    def _rays(self) -> tuple[np.ndarray, np.ndarray]:
        """The eye (3,) [m] and unit vectors (height * width, 3), row by row from the top left."""
        left, right = self.scene.camera[:2]
        height, width = self._shape
        forward, up = np.array(left.forward, dtype=float), np.array(left.up, dtype=float)
        slope = left.frustum_top / left.frustum_near
        rows = slope * (1.0 - (2.0 * np.arange(height) + 1.0) / height)
        columns = slope * width / height * ((2.0 * np.arange(width) + 1.0) / width - 1.0)
        rays = forward + rows[:, None, None] * up + columns[None, :, None] * np.cross(forward, up)
        eye = 0.5 * (np.array(left.pos, dtype=float) + np.array(right.pos, dtype=float))  # between a viewer's two
        return eye, _unit(rays).reshape(-1, 3)

    def _cast(self, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What each ray meets first: the geom (N,), -1 if none, its distance (N,) [m] and the normal there (N, 3)."""
        if self._floor < 0:
            return self._follow(origin, rays)
        with np.errstate(divide="ignore"):
            distance = -origin[2] / rays[:, 2]
        down = (distance > 0.0) & (distance < _FARTHEST_M)
        geom, distance = np.where(down, self._floor, -1).astype(np.int32), np.where(down, distance, _FARTHEST_M)
        normal = np.tile([0.0, 0.0, 1.0], (len(rays), 1))
        near, *_ = _meet(self._bounds(), origin, rays, np.full(len(rays), np.inf))
        geom[near], distance[near], normal[near] = self._follow(origin, rays[near])
        return geom, distance, normal

    def _follow(self, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `_cast`, by MuJoCo."""
        count = len(rays)
        geom, distance, normal = np.empty(count, dtype=np.int32), np.empty(count), np.empty(3 * count)
        mujoco.mj_multiRay(
            self._model, self._data, origin, rays.ravel(), _SHOWN_GROUPS, 1, -1, geom, distance, normal, count,
            _FARTHEST_M,
        )  # fmt: skip
        hit = (geom >= 0) & (distance < _FARTHEST_M)  # MuJoCo follows rays to endless planes farther than it was asked
        return np.where(hit, geom, -1), np.where(hit, distance, _FARTHEST_M), normal.reshape(-1, 3)

    def _bounds(self) -> tuple[np.ndarray, float]:
        """Centre (3,) and radius [m] of a ball around the robot."""
        places = self._data.geom_xpos[self._parts]
        center = 0.5 * (places.min(0) + places.max(0))
        return center, float((np.linalg.norm(places - center, axis=1) + self._model.geom_rbound[self._parts]).max())

    def _lit(self, points: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """The lamp's light on each point (N,): less where a ray from the lamp ends before it. The lamp is so far away
        that its rays are as good as parallel."""
        lamp = self._data.subtree_com[0] + _LAMP_M * self._to_lamp
        away = points - lamp
        length = np.linalg.norm(away, axis=1)
        geom, distance, _ = self._cast(lamp, away / length[:, None])
        return np.maximum(0.0, normal @ self._to_lamp) * np.where((geom >= 0) & (distance < length - 0.01), _SHADE, 1.0)

    def _surface(self, geom: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Colours (N, 3) of geoms (N,) at points (N, 3) [m] in the world."""
        model = self._model
        material = model.geom_matid[geom]
        color = model.geom_rgba[geom, :3].astype(float)
        for number in range(model.nmat):
            of, texture = material == number, model.mat_texid[number, mujoco.mjtTextureRole.mjTEXROLE_RGB]
            color[of] = model.mat_rgba[number, :3]
            if texture >= 0:
                color[of] *= self._texture(texture, points[of, :2] * model.mat_texrepeat[number])
        return color

    def _texture(self, texture: int, place: np.ndarray) -> np.ndarray:
        """Colours (N, 3) of a texture that repeats every two units of `place` (N, 2), as MuJoCo lays it on planes."""
        model = self._model
        height, width, channels = (int(a[texture]) for a in (model.tex_height, model.tex_width, model.tex_nchannel))
        start = int(model.tex_adr[texture])
        image = model.tex_data[start : start + height * width * channels].reshape(height, width, channels)[..., :3]
        column, row = (np.mod(0.5 * place + 0.5, 1.0) * (width, height)).astype(int).T
        return image[row, column] / 255.0


def _unit(vectors: np.ndarray) -> np.ndarray:
    """`vectors` (..., 3) of length 1."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _balls(mark: mujoco.MjvGeom) -> list[tuple[np.ndarray, float]]:
    """Centres (3,) and radii [m] of balls that together look like a ball or an arrow."""
    center, radius = np.array(mark.pos, dtype=float), float(mark.size[0])
    if mark.type == mujoco.mjtGeom.mjGEOM_SPHERE:
        return [(center, radius)]
    if mark.type != mujoco.mjtGeom.mjGEOM_ARROW:
        raise ValueError(f"only balls and arrows can be drawn beside a robot, got geom type {mark.type}")
    length, axis = float(mark.size[2]), np.array(mark.mat, dtype=float)[:, 2]
    head = 5.0 * radius  # its length; it is as wide as it is long
    places = np.linspace(length, 0.0, max(2, round(2.0 * length / radius)))
    return [(center + z * axis, 0.5 * (length - z) + 0.1 * radius if length - z < head else radius) for z in places]


def _meet(
    ball: tuple[np.ndarray, float], origin: np.ndarray, rays: np.ndarray, farthest: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The rays (M,) that meet a ball before `farthest` (N,) [m], their distance (M,) and the normal there (M, 3)."""
    center, radius = ball
    along = rays @ (center - origin)
    inside = radius**2 - (center - origin) @ (center - origin) + along**2
    (seen,) = np.nonzero((inside > 0.0) & (along > 0.0))
    at = along[seen] - np.sqrt(inside[seen])
    seen, at = seen[at < farthest[seen]], at[at < farthest[seen]]
    return seen, at, (origin + at[:, None] * rays[seen] - center) / radius
