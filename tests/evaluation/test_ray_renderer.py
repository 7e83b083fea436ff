"""Pictures against geometry worked by hand: where a ball is seen, how large, what lies in its shadow."""

import math

import mujoco
import numpy as np
import pytest

from cotap.evaluation.ray_renderer import RayRenderer
from cotap.evaluation.render import add_arrow, add_ball, render_frames
from cotap.robots.mjcf import build_model

SIZE, HALF_ANGLE = 201, math.radians(20.0)  # an odd number: the middle pixel looks straight ahead
RADIUS, HEIGHT = 0.25, 1.0
SCENE = f"""
<mujoco>
  <visual><headlight ambient="0.2 0.2 0.2" diffuse="0 0 0"/></visual>
  <worldbody>
    {{ground}}
    <light type="directional" dir="0 0.6 -0.8" diffuse="0.5 0.5 0.5"/>
    <body pos="0 0 {HEIGHT}"><freejoint/><geom type="sphere" size="{RADIUS}" rgba="1 0 0 1"/></body>
    <camera name="track" pos="0 -5 {HEIGHT}" xyaxes="1 0 0 0 0 1" fovy="40"/>
    <camera name="above" pos="0 0 6" xyaxes="1 0 0 0 1 0" fovy="40"/>
  </worldbody>
</mujoco>"""
FLOOR = '<geom type="plane" size="0 0 1" rgba="1 1 1 1"/>'
ALIKE = FLOOR + '<geom type="sphere" size="0.01" pos="0 0 -1"/>'  # not a floor alone: every ray is MuJoCo's


def see(camera="track", ground=FLOOR, mark=None) -> np.ndarray:
    model = mujoco.MjModel.from_xml_string(SCENE.format(ground=ground))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = RayRenderer(model, SIZE, SIZE)
    renderer.update_scene(data, camera)
    if mark:
        mark(renderer.scene)
    return renderer.render().astype(int)


def pixel(picture: np.ndarray, across: float, up: float, distance: float) -> np.ndarray:
    """The colour (3,) of a point that lies so far to the right and above of what a camera looks at [m]."""
    scale = 0.5 * SIZE / (distance * math.tan(HALF_ANGLE))
    middle = SIZE // 2
    return picture[middle - round(up * scale), middle + round(across * scale)]


def test_a_ball_is_seen_where_and_as_large_as_it_is():
    red = see()[..., 0] > see()[..., 1] + 20
    rows, columns = np.nonzero(red)
    assert rows.mean() == pytest.approx(SIZE // 2, abs=0.5)
    assert columns.mean() == pytest.approx(SIZE // 2, abs=0.5)
    # The tangent of the cone around a ball: its radius over the length of the tangent line.
    apparent = RADIUS / math.sqrt(25.0 - RADIUS**2) / math.tan(HALF_ANGLE) * 0.5 * SIZE
    assert red.sum() == pytest.approx(math.pi * apparent**2, rel=0.03)


def test_light_falls_on_what_the_lamp_sees_by_the_cosine():
    picture = see("above")
    lit = pixel(picture, 1.5, 0.0, 6.0)
    np.testing.assert_allclose(lit, 255 * (0.2 + 0.5 * 0.8) * 0.9856 + 3, atol=3)  # a little haze
    shade = pixel(picture, 0.0, 0.75, 6.0)  # light that passes the ball at 1 m comes down 0.6 / 0.8 m ahead
    np.testing.assert_allclose(shade, 255 * (0.2 + 0.35 * 0.5 * 0.8) * 0.9856 + 3, atol=3)
    np.testing.assert_allclose(pixel(picture, 0.0, -0.75, 6.0), lit, atol=3)
    top = pixel(picture, 0.0, 0.0, 5.0)
    np.testing.assert_allclose(top, [255 * (0.2 + 0.5 * 0.8), 0, 0], atol=5)


@pytest.mark.parametrize("camera", ["track", "above"])
def test_a_floor_is_drawn_as_mujoco_finds_it(camera):
    np.testing.assert_allclose(see(camera), see(camera, ALIKE), atol=1)


def test_marks_are_before_or_behind_what_is_there():
    blue = (0.0, 0.0, 1.0, 1.0)
    before = see(mark=lambda scene: add_ball(scene, np.array([0.0, -1.0, HEIGHT]), blue, 0.1))
    assert pixel(before, 0.0, 0.0, 4.0)[2] > 100
    behind = see(mark=lambda scene: add_ball(scene, np.array([0.0, 1.0, HEIGHT]), blue, 0.1))
    np.testing.assert_array_equal(behind, see())


def test_an_arrow_goes_from_its_tail_to_its_tip():
    tail, tip = np.array([-0.8, -0.5, 1.4]), np.array([0.8, -0.5, 1.4])
    picture = see(mark=lambda scene: add_arrow(scene, tail, tip, (0.0, 0.0, 1.0, 1.0)))
    blue = (picture[..., 2] > 60) & (picture[..., 0] < 30)
    scale = 0.5 * SIZE / (4.5 * math.tan(HALF_ANGLE))
    columns = np.nonzero(blue.any(0))[0] - SIZE // 2
    assert columns.min() == pytest.approx(-0.8 * scale, abs=2)
    assert columns.max() == pytest.approx(0.8 * scale, abs=2)
    widths = blue.sum(0)
    assert widths[SIZE // 2 + round(0.72 * scale)] > widths[SIZE // 2]  # its head


def test_what_is_no_mark_is_refused():
    def box(scene: mujoco.MjvScene) -> None:
        scene.ngeom += 1
        mujoco.mjv_initGeom(
            scene.geoms[0], mujoco.mjtGeom.mjGEOM_BOX, np.ones(3), np.zeros(3), np.eye(3).ravel(),
            np.ones(4, dtype=np.float32),
        )  # fmt: skip

    with pytest.raises(ValueError, match="only balls and arrows"):
        see(mark=box)


def test_every_robot_is_drawn_on_its_chequered_floor(any_spec):
    import torch

    pose = torch.from_numpy(build_model(any_spec).qpos0.copy())
    (picture,) = render_frames(any_spec, pose[None], 320, 240)
    assert picture.shape == (240, 320, 3)
    assert picture.dtype == np.uint8
    assert len(np.unique(picture[-20:].reshape(-1, 3), axis=0)) > 20  # squares and lines between them
    assert (picture.min(2) < 60).sum() > 100  # the robot's dark parts
