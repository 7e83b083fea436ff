"""What is drawn with where there is no display, and that nothing is asked for that is missing."""

import ctypes.util
import os
import subprocess
import sys

import pytest

from cotap import graphics


@pytest.mark.parametrize(
    ("driver", "libraries", "before", "chosen"),
    [(True, {"EGL", "OSMesa"}, None, "egl"), (False, {"EGL", "OSMesa"}, None, "osmesa"),
     (True, {"OSMesa"}, None, "osmesa"), (False, {"EGL"}, None, None), (True, set(), None, None),
     (True, {"EGL"}, "glfw", "glfw"), (False, {"OSMesa"}, "egl", "egl")],
)  # fmt: skip
def test_what_is_there_is_chosen_and_a_choice_is_kept(driver, libraries, before, chosen, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(graphics, "DRIVERS", tmp_path if driver else tmp_path / "none")
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: f"lib{name}.so" if name in libraries else None)
    monkeypatch.setenv("MUJOCO_GL", before or "")
    if before is None:
        monkeypatch.delenv("MUJOCO_GL")
    graphics.choose_opengl()
    assert os.environ.get("MUJOCO_GL") == chosen


def test_mujoco_draws_with_what_is_chosen_after_it_was_imported(monkeypatch):
    module = "mujoco.rendering.classic.gl_context"
    loaded = []
    monkeypatch.setattr(graphics.importlib, "reload", loaded.append)
    monkeypatch.setattr(graphics, "choose_opengl", lambda: os.environ.setdefault("MUJOCO_GL", "osmesa"))
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    graphics.bind_opengl()  # a choice that was made is kept
    assert loaded == []
    monkeypatch.delenv("MUJOCO_GL")
    graphics.bind_opengl()
    assert loaded == [sys.modules[module]]


def test_mujoco_can_be_imported_with_what_is_chosen_here():
    environment = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    code = "from cotap.graphics import choose_opengl; choose_opengl(); import mujoco"
    subprocess.run([sys.executable, "-c", code], check=True, env=environment, timeout=120)
