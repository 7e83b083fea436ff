"""Playing clips of a motion library: one clip and one place in it per env, looped."""

from __future__ import annotations

import torch

from cotap.motions.library import FPS, MotionLibrary
from cotap.persistence import Stateful


class ClipPlayer(Stateful):
    """Positions in the clips of a library, for N envs. All clips lie in one tensor, whatever their number.

    Args:
        library: The clips.
        num_envs: Number of envs.
        dt: Control step [s].
    """

    STATE = ("clip", "_frame")

    def __init__(self, library: MotionLibrary, num_envs: int, dt: float) -> None:
        self._advance = dt * FPS
        self.names = library.names()
        lengths = torch.tensor([len(c.arms) for c in library.clips])
        self._last = (lengths - 1).float()
        self._start = lengths.cumsum(0) - lengths
        self._frames = torch.cat([torch.as_tensor(c.arms) for c in library.clips])
        self._root_velocity = torch.cat([root_velocity(torch.as_tensor(c.root)) for c in library.clips])
        self.clip = torch.zeros(num_envs, dtype=torch.long)
        self._frame = torch.zeros(num_envs)

    def draw(self, mask: torch.Tensor, rng: torch.Generator) -> None:
        """A random clip, at a random place, in the envs of `mask`. Clips are equally likely."""
        n = int(mask.sum())
        clip = torch.randint(0, len(self.names), (n,), generator=rng, device=rng.device)
        self.clip[mask] = clip
        self._frame[mask] = torch.rand(n, generator=rng, device=rng.device) * self._last[clip]

    def start(self, mask: torch.Tensor, clip: int) -> None:
        """Begin clip number `clip` in the envs of `mask`."""
        self.clip[mask] = clip
        self._frame[mask] = 0.0

    def step(self) -> torch.Tensor:
        """Advance by one control step. Returns the envs (N,) whose clip began again."""
        frame, last = self._frame + self._advance, self._last[self.clip]
        over = frame > last
        self._frame = torch.where(over, frame - last, frame).clamp_max(last)
        return over

    def current(self) -> torch.Tensor:
        """Joint angles (N, U) now [rad], interpolated between frames."""
        row, share = self._row()
        return torch.lerp(self._frames[row], self._frames[row + 1], share.unsqueeze(1))

    def root_velocity(self) -> torch.Tensor:
        """The clip's root velocity (N, 3) now: forward, leftward [m/s], turning [rad/s]."""
        return self._root_velocity[self._row()[0]]

    def _row(self) -> tuple[torch.Tensor, torch.Tensor]:
        """The frame before now, never a clip's last, and the share of the way to the next."""
        whole = torch.minimum(self._frame.floor(), self._last[self.clip] - 1.0)
        return self._start[self.clip] + whole.long(), self._frame - whole


def root_velocity(root: torch.Tensor) -> torch.Tensor:
    """Velocities (T, 3) of a path (T, 3) of x, y and heading, in the path's own heading frame: [m/s], [rad/s]."""
    rate = root.diff(dim=0) * FPS
    rate = torch.cat((rate, rate[-1:]))
    c, s = root[:, 2].cos(), root[:, 2].sin()
    return torch.stack((c * rate[:, 0] + s * rate[:, 1], c * rate[:, 1] - s * rate[:, 0], rate[:, 2]), 1)
