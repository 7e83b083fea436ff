"""The three-dimensional part of the page: robots, hands, forces, ellipsoids of stiffness, contacts, the floor."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import trimesh
import viser
from mjviser import ViserMujocoScene
from viser import transforms as tf

from cotap.play.visuals import RobotPose, visual_model
from cotap.robots import RobotSpec

if TYPE_CHECKING:  # the scene is shown before torch is there
    from cotap.play.sample import Sample

APART_M = 1.5
"""How far to its right the second robot is shown from where its own env has it [m]."""
JUMP_M = 1.0
"""Robots that have moved further than this between two pictures were put elsewhere [m]."""
ELLIPSOID_M = 3e-4
"""Half axis of an ellipsoid of stiffness per stiffness [m per N/m]: 30 cm for 1000 N/m."""
ELLIPSOID_MAX_M = 0.5
"""Longest half axis: along a straight arm there is no end to the stiffness [m]."""
ARROW_M = 0.004
"""Length of a force's arrow per force [m/N]."""
ARROW_MAX_M = 1.5
"""Longest arrow [m]."""
SHAFT_RADIUS_M, HEAD_RADIUS_M, HEAD_LENGTH_M = 0.012, 0.03, 0.06
"""Of an arrow [m]."""
HAND_M, REFERENCE_M = 0.055, 0.04
"""Radii of the balls at hands and at their references [m]."""
HIDDEN = 1e-6
"""Scale of what is not there: sizes of batches stay as they are."""
HAND, REFERENCE, FORCE, CONTACT = (230, 120, 40), (40, 170, 80), (200, 30, 50), (230, 153, 51)
GROUND_LIGHT = (120, 120, 130)
COMMANDED, EFFECTIVE = (40, 110, 220), (240, 150, 60)


class Scene:
    """Draws samples. Robots' envs are their own; here they stand beside each other.

    Args:
        server: Where to draw.
        spec: The robot.
        count: How many robots samples hold at most.
    """

    def __init__(self, server: viser.ViserServer, spec: RobotSpec, count: int) -> None:
        self.shown = 1
        """How many robots, from the first on, are drawn; those that a sample lacks are not."""
        self.follow = True
        """Whether the robots stay where cameras look; if not, they walk away, but are found again after a reset."""
        self.ellipsoids, self.contacts = True, True
        self._server, self._count, self._hands = server, count, len(spec.arms)
        model, self.shapes = visual_model(spec)
        self._pose = RobotPose(spec, model)
        with server.atomic():  # no browser sees what mjviser asks for before it is changed
            self._robots = ViserMujocoScene(server, model, count)
            self._robots.camera_tracking_enabled = False
            self._add_surroundings()
        ball = trimesh.creation.icosphere(subdivisions=2)
        self.hands = self._batch("hands", ball, HAND, HAND_M)
        """Balls at the hands, robot by robot, to be taken hold of."""
        self._references = self._batch("references", ball, REFERENCE, REFERENCE_M)
        self._effective = self._batch("effective", trimesh.creation.icosphere(subdivisions=3), EFFECTIVE, 0.0, 0.35)
        self._commanded = self._batch("commanded", ball, COMMANDED, 0.0, wireframe=True)
        # Not viser's own arrows: when they are first shown, their heads lie where they were made.
        self._shafts = self._batch("force_shafts", trimesh.creation.cylinder(radius=1.0, height=1.0), FORCE, 0.0)
        self._heads = self._batch("force_heads", trimesh.creation.cone(radius=1.0, height=1.0), FORCE, 0.0)
        self._contact_points = server.scene.add_point_cloud(
            "/contacts", np.zeros((1, 3)), CONTACT, point_size=0.025, point_shape="circle", visible=False
        )
        self._middle = np.zeros(3)
        self._offset = np.zeros((count, 3))

    def show(self, sample: Sample) -> None:
        """Draw one step."""
        rows = len(sample["qpos"])
        shown = min(self.shown, rows)
        # Batches keep their sizes: the last robot stands in for those that are lacking, hidden.
        sample = {name: value[np.minimum(np.arange(self._count), rows - 1)] for name, value in sample.items()}
        poses = [self._pose.of(qpos) for qpos in sample["qpos"]]
        apart = np.array([[0.0, -APART_M * i, 0.0] for i in range(self._count)])
        # Following moves the scene, not people's cameras: those stay theirs to turn.
        middle = apart[:shown].mean(0) + np.array([*sample["qpos"][:shown, :2].mean(0), 0.0])
        jumped = float(np.linalg.norm(middle - self._middle)) > JUMP_M
        self._middle = middle
        if self.follow or jumped:
            self._offset = apart - middle
        with self._server.atomic():
            self._floor.position = self._offset[0]
            self._robots.show_only_selected = shown < self._count
            self._robots.update_from_arrays(
                np.stack([p[0] for p in poses]) + self._offset[:, None], np.stack([p[1] for p in poses]), env_idx=0
            )
            self._show_hands(sample, shown)
            self._show_forces(sample, shown)
            self._show_contacts([p[2] for p in poses[:shown]])
        self._server.flush()

    def cast_shadows(self, on: bool) -> None:
        """Whether things cast shadows; without a GPU, a browser draws few pictures per second then."""
        self._server.scene.configure_default_lights(cast_shadow=on)

    def to_robot(self, point: tuple[float, float, float], robot: int) -> tuple[float, ...]:
        """A point of the page in the world frame of a robot's env."""
        return tuple(float(v) for v in np.asarray(point) - self._offset[robot])

    def _add_surroundings(self) -> None:
        scene = self._server.scene
        scene.configure_environment_map(hdri=None)  # mjviser asks for one
        scene.add_light_hemisphere("/sky", ground_color=GROUND_LIGHT, intensity=0.8)
        self._floor = scene.add_frame("/floor", show_axes=False)
        scene.add_grid(
            "/floor/grid", infinite_grid=True, cell_size=0.5, section_size=1.0, fade_distance=25.0, plane_opacity=0.5,
            shadow_opacity=0.25,
        )  # fmt: skip
        self._server.initial_camera.position = (2.9, 1.5, 1.5)
        self._server.initial_camera.look_at = (0.0, 0.35, 0.8)  # the second robot is to the first one's right

    def _batch(
        self, name: str, mesh: trimesh.Trimesh, color: tuple[int, int, int], size: float, opacity: float | None = None,
        wireframe: bool = False,
    ) -> viser.BatchedMeshHandle:  # fmt: skip
        """One mesh for every hand of every robot."""
        n = self._count * self._hands
        return self._server.scene.add_batched_meshes_simple(
            f"/{name}", mesh.vertices, mesh.faces, np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)), np.zeros((n, 3)),
            batched_scales=np.full((n, 3), max(size, HIDDEN)), batched_colors=color, opacity=opacity,
            wireframe=wireframe, cast_shadow=False, receive_shadow=False, lod="off",
        )  # fmt: skip

    def _show_hands(self, s: Sample, shown: int) -> None:
        place = self._offset[:, None]
        there = np.where(np.arange(self._count) < shown, 1.0, HIDDEN)
        visible = np.broadcast_to(there[:, None, None], (self._count, self._hands, 1))
        hands = _batched(s["hand_w"] + place)
        self.hands.batched_positions = hands
        self._references.batched_positions = _batched(s["hand_reference_w"] + place)
        for handle, size in ((self.hands, HAND_M), (self._references, REFERENCE_M)):
            handle.batched_scales = _batched(np.repeat(size * visible, 3, 2))
        heading = np.repeat(s["heading_w"][:, None], self._hands, 1)
        commanded = np.nan_to_num(s["commanded_stiffness"], nan=0.0)
        values, axes = np.linalg.eigh(s["effective_stiffness"])
        axes[..., 0] *= np.sign(np.linalg.det(axes))[..., None]  # a rotation, not a reflection
        for handle, stiffness, rotation in (
            (self._commanded, commanded, heading), (self._effective, values, heading @ axes),
        ):  # fmt: skip
            size = np.clip(ELLIPSOID_M * stiffness, HIDDEN, ELLIPSOID_MAX_M) * (visible if self.ellipsoids else HIDDEN)
            handle.batched_positions = hands
            turn = tf.SO3.from_matrix(rotation.reshape(-1, 3, 3).astype(np.float64))
            handle.batched_wxyzs = turn.wxyz.astype(np.float32)
            handle.batched_scales = _batched(np.maximum(size, HIDDEN))

    def _show_forces(self, s: Sample, shown: int) -> None:
        force = s["hand_force_w"].reshape(-1, 3)
        size = np.linalg.norm(force, axis=1, keepdims=True)
        on = (size > 0.1) & (np.arange(len(force)) < shown * self._hands)[:, None]
        along = np.where(on, force / np.maximum(size, 0.1), (0.0, 0.0, 1.0))
        tip = (s["hand_w"] + self._offset[:, None]).reshape(-1, 3)
        shaft = np.minimum(ARROW_M * size, ARROW_MAX_M - HEAD_LENGTH_M)
        turn = _turned_from_z(along)
        # The arrow ends where it pushes.
        base = tip - HEAD_LENGTH_M * along
        for handle, position, radius, length in (
            (self._shafts, base - 0.5 * shaft * along, SHAFT_RADIUS_M, shaft),
            (self._heads, base, HEAD_RADIUS_M, np.full_like(size, HEAD_LENGTH_M)),
        ):
            scale = np.concatenate((np.full((len(force), 2), radius), length), 1)
            handle.batched_positions = position.astype(np.float32)
            handle.batched_wxyzs = turn
            handle.batched_scales = np.where(on, np.maximum(scale, HIDDEN), HIDDEN).astype(np.float32)

    def _show_contacts(self, contacts: list[np.ndarray]) -> None:
        points = [c + self._offset[i] for i, c in enumerate(contacts)]
        points = np.concatenate(points) if points else np.zeros((0, 3))
        self._contact_points.visible = bool(len(points)) and self.contacts
        if len(points):
            self._contact_points.points = points.astype(np.float32)


def _batched(values: np.ndarray) -> np.ndarray:
    """(N, H, 3) as browsers take it, (N H, 3)."""
    return values.reshape(-1, 3).astype(np.float32)


def _turned_from_z(along: np.ndarray) -> np.ndarray:
    """Quaternions (N, 4), w first, of the shortest turns from z to unit vectors (N, 3); a half turn about x where they
    point down."""
    x, y, z = along.T
    turn = np.stack((1.0 + z, -y, x, np.zeros_like(z)), 1)
    turn[z < -1.0 + 1e-9] = (0.0, 1.0, 0.0, 0.0)
    return (turn / np.linalg.norm(turn, axis=1, keepdims=True)).astype(np.float32)
