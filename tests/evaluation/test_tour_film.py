"""A film of the tour: where waypoints and punches are drawn, and how long it is."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch

from cotap.envs.punches import PunchConfig, Punches
from cotap.evaluate import evaluate
from cotap.evaluation.tour.film import TourMarks


def drawn(spec, model, time_s: float) -> list:
    """Geoms of the picture at a time, two segments of 5 s, punches from 0.1 s on."""
    waypoints = torch.tensor([[0.5, -0.2, math.pi / 2], [-0.3, 0.4, 0.0]])
    marks = TourMarks(spec, waypoints, 5.0, Punches(PunchConfig(500.0, count=2), len(spec.joints), 1, 0.02), 0.04)
    data, scene = mujoco.MjData(model), mujoco.MjvScene(model, 10)
    data.qpos[2] = 1.0
    mujoco.mj_forward(model, data)
    marks(scene, data, round(time_s / 0.04))
    return [scene.geoms[i] for i in range(scene.ngeom)]


def tip(arrow) -> np.ndarray:
    return arrow.pos + arrow.mat[:, 2] * arrow.size[2]


def test_the_waypoint_of_the_segment_and_its_heading_are_on_the_floor(any_spec, any_model):
    ball, arrow = drawn(any_spec, any_model, 4.0)
    np.testing.assert_allclose(ball.pos, [0.5, -0.2, 0.03], atol=1e-6)
    np.testing.assert_allclose(tip(arrow) - arrow.pos, [0.0, 0.35, 0.0], atol=1e-6)
    for time_s in (6.0, 20.0):
        np.testing.assert_allclose(drawn(any_spec, any_model, time_s)[0].pos, [-0.3, 0.4, 0.03], atol=1e-6)


def test_a_punch_is_an_arrow_at_the_joint_for_a_moment(any_spec, any_model):
    assert [len(drawn(any_spec, any_model, t)) for t in (0.08, 0.12, 0.48, 0.52, 4.96, 5.12)] == [2, 3, 3, 2, 2, 3]
    for segment, time_s in ((0, 0.2), (1, 5.2)):
        *_, arrow = drawn(any_spec, any_model, time_s)
        punches = Punches(PunchConfig(500.0, count=2), len(any_spec.joints), 1, 0.02)
        data = mujoco.MjData(any_model)
        data.qpos[2] = 1.0
        mujoco.mj_forward(any_model, data)
        joint = any_spec.joint_names[punches.joint[0, segment]]
        np.testing.assert_allclose(tip(arrow), data.joint(joint).xanchor, atol=1e-5)
        along = (tip(arrow) - arrow.pos) @ punches.force_w[0, segment].double().numpy()
        assert along == pytest.approx(arrow.size[2] * float(punches.force_w[0, segment].norm()), rel=1e-4)


@pytest.mark.parametrize("force", ["0", "500"])
def test_the_first_run_is_filmed_to_its_end(checkpoint, tmp_path, monkeypatch, force):
    filmed = []
    monkeypatch.setattr("cotap.evaluation.render.film_video", lambda *args: filmed.append(args))
    options = ["--episode-seconds", "1.2", "--waypoints", "2", "--threads", "1", "--force-size", force]
    evaluate(["tour", "--checkpoint", str(checkpoint), "--num-envs", "2", "--video", str(tmp_path / "t.mp4"), *options])
    _, env, film, sheet, marks = filmed[0]
    assert film.shape == (60, env.sim.model.nq + 12)  # 1.2 s
    assert sheet == tmp_path / "t_frames.png"
    assert marks._punches.active == (force == "500")
