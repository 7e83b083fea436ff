"""Which OpenGL MuJoCo draws with where there is no display."""

from __future__ import annotations

import ctypes.util
import importlib
import os
import sys
from pathlib import Path

DRIVERS = Path("/dev/dri")
"""Where Linux lists graphics drivers."""


def choose_opengl() -> None:
    """On Linux, set `MUJOCO_GL`, unless it is set, to what draws without a display here: EGL with a graphics driver,
    else OSMesa. Where there is neither, leave it: mujoco cannot even be imported with a library that is missing.
    """
    if sys.platform != "linux":
        return
    if DRIVERS.exists() and ctypes.util.find_library("EGL"):
        os.environ.setdefault("MUJOCO_GL", "egl")
    elif ctypes.util.find_library("OSMesa"):
        os.environ.setdefault("MUJOCO_GL", "osmesa")


def bind_opengl() -> None:
    """Have mujoco, imported or not, draw with what `choose_opengl` chooses. To be called before it first draws."""
    if "MUJOCO_GL" in os.environ:
        return
    choose_opengl()
    if "MUJOCO_GL" in os.environ:  # mujoco reads it once, when this module is loaded
        importlib.reload(importlib.import_module("mujoco.rendering.classic.gl_context"))
