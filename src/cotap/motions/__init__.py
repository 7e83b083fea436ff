"""Human motion for robot arms: libraries of clips, importers of public formats, retargeting."""

from cotap.motions.library import MotionClip, MotionError, MotionLibrary, shipped_library

__all__ = ["MotionClip", "MotionError", "MotionLibrary", "shipped_library"]
