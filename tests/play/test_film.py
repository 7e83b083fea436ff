"""Recordings as films, and samples with fewer robots than the scene: what is drawn, without a browser."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import imageio.v2 as imageio
import numpy as np
import pytest
from viser import transforms as tf

from cotap.play import ROBOTS
from cotap.play.archive import Archive
from cotap.play.notices import Notices
from cotap.play.recorder import samples_of
from cotap.play.scene import HAND_M, Scene


@pytest.fixture
def scene(server, session):
    return Scene(server, session.env.spec, len(ROBOTS))


@pytest.fixture
def archive(server, tmp_path, monkeypatch):
    archive = Archive(tmp_path, Notices(server))
    archive.notices = []
    monkeypatch.setattr(archive._notices, "tell", lambda text, *_: archive.notices.append(text))
    return archive


class Browser:
    """Stands in for a viewer's browser: grey pictures, and what the scene had in it for each."""

    def __init__(self, archive, scene, fails_after=1000):
        self.camera = SimpleNamespace(position=np.ones(3), wxyz=np.array([1.0, 0.0, 0.0, 0.0]), fov=1.0)
        self.archive, self.scene, self.fails_after = archive, scene, fails_after
        self.seen, self.downloads = [], {}

    def get_render(self, *_, **__):
        if len(self.seen) == self.fails_after:
            raise TimeoutError("no picture")
        assert self.archive.filming.is_set()
        assert self.archive.drawing.locked()
        self.seen.append((self.scene.shown, drawn_hands(self.scene), len(drawn_bodies(self.scene))))
        return np.full((64, 96, 4), 128, dtype=np.uint8)

    def send_file_download(self, name, content):
        self.downloads[name] = content


def drawn_hands(scene):
    return int((scene.hands.batched_scales[:, 0] > 0.9 * HAND_M).sum())


def drawn_arrows(scene):
    """Of every hand of every robot, whether an arrow points at it."""
    shafts, heads = ((handle.batched_scales > 1e-3).all(1).tolist() for handle in (scene._shafts, scene._heads))
    assert shafts == heads
    return shafts


def drawn_bodies(scene):
    """Of the first body that moves, as many as robots are drawn."""
    group = scene._robots._mesh_groups[0]
    positions = group.handle.batched_positions
    assert len(positions) == len(group.handle.batched_wxyzs)
    assert len(positions) % len(group.body_ids) == 0
    return positions.reshape(-1, len(group.body_ids), 3)


@pytest.mark.parametrize(("recorded", "shown"), [(2, 1), (1, 2), (2, 2), (1, 1)])
def test_a_film_shows_the_robots_of_the_recording_whatever_the_page_shows(archive, scene, record, recorded, shown):
    archive.keep(record(11, recorded))
    scene.shown = shown
    browser = Browser(archive, scene)
    archive.film(browser, scene)
    assert browser.seen == [(recorded, 2 * recorded, recorded)] * 6  # every other of 11 steps of 20 ms
    assert scene.shown == shown
    assert not archive.filming.is_set()
    assert not archive.drawing.locked()
    film = archive.path.with_suffix(".mp4")
    assert browser.downloads == {film.name: film.read_bytes()}
    assert film.read_bytes()[4:8] == b"ftyp"
    assert archive.notices == [f"written to {film}"]


@pytest.mark.parametrize(("dt", "stride"), [(0.02, 2), (0.015, 3), (0.05, 1)])
def test_a_film_lasts_as_long_as_what_it_shows(archive, scene, record, dt, stride):
    recording = record(12, 1)
    recording = replace(recording, trajectory=replace(recording.trajectory, dt=dt))
    archive.keep(recording)
    browser = Browser(archive, scene)
    archive.film(browser, scene)
    assert len(browser.seen) == 12 // stride
    with imageio.get_reader(archive.path.with_suffix(".mp4")) as film:
        assert film.get_meta_data()["fps"] == pytest.approx(1.0 / (stride * dt), abs=0.01)


def test_a_browser_that_stops_drawing_leaves_no_film_and_the_page_as_it_was(archive, scene, record):
    archive.keep(record(11, 2))
    browser = Browser(archive, scene, fails_after=2)
    archive.film(browser, scene)
    (text,) = archive.notices
    assert "keep its tab in front" in text
    assert not archive.path.with_suffix(".mp4").exists()
    assert browser.downloads == {}
    assert scene.shown == 1
    assert not archive.filming.is_set()
    assert not archive.drawing.locked()


def test_before_anything_is_recorded_there_is_nothing_to_film(archive, scene):
    archive.film(Browser(archive, scene), scene)
    assert archive.notices == ["record something first"]


@pytest.mark.parametrize("force", [(30.0, 0.0, 0.0), (0.0, 0.0, -30.0), (0.0, 0.0, 30.0), (10.0, -20.0, 5.0)])
def test_the_arrow_of_the_first_push_is_whole_and_ends_at_the_hand(scene, record, force):
    """Before it, no part of an arrow is seen; heads and shafts wait at the hands."""
    (before,), (pushed,) = samples_of(record(1, 1)), samples_of(record(1, 1))
    before["hand_force_w"][:] = pushed["hand_force_w"][:] = 0.0
    pushed["hand_force_w"][0, 0] = force
    scene.show(before)
    assert drawn_arrows(scene) == [False] * 4
    scene.show(pushed)
    assert drawn_arrows(scene) == [True, False, False, False]
    hand = pushed["hand_w"][0, 0] + scene._offset[0]
    along = np.array(force) / np.linalg.norm(force)
    turns = [tf.SO3(handle.batched_wxyzs[0].astype(float)) for handle in (scene._shafts, scene._heads)]
    for turn in turns:
        np.testing.assert_allclose(turn.as_matrix()[:, 2], along, atol=1e-5)
    # A head reaches from its base by its length, a shaft by half of it either way.
    head, shaft = (handle.batched_positions[0] for handle in (scene._heads, scene._shafts))
    head_length, shaft_length = (handle.batched_scales[0, 2] for handle in (scene._heads, scene._shafts))
    np.testing.assert_allclose(head + head_length * along, hand, atol=1e-5)
    np.testing.assert_allclose(shaft + 0.5 * shaft_length * along, head, atol=1e-5)
    assert shaft_length == pytest.approx(0.004 * np.linalg.norm(force), rel=1e-4)


def test_a_sample_of_one_robot_is_drawn_alone_where_two_are_asked_for(scene, record):
    (sample,) = samples_of(record(1, 1))
    sample["hand_force_w"][0, 0] = (20.0, 0.0, 0.0)
    scene.shown = 2
    scene.show(sample)
    assert drawn_hands(scene) == 2
    assert len(drawn_bodies(scene)) == 1
    assert drawn_arrows(scene) == [True, False, False, False]
    for ellipsoids in (scene._commanded, scene._effective):
        assert ((ellipsoids.batched_scales > 1e-3).all(1)).tolist() == [True, True, False, False]
    # The robot is in the middle, as it is when it is alone on the page.
    np.testing.assert_allclose(scene._offset[0], [*-sample["qpos"][0, :2], 0.0], atol=1e-6)
    assert scene.shown == 2
