"""One figure from several trainings: its mean, its range, and where that of a further training would lie."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import mean, stdev

from scipy.stats import t as student


@dataclass(frozen=True)
class Trainings:
    """A measure in each of a few trainings that differ in their seed alone."""

    values: tuple[float, ...]

    @property
    def interval(self) -> tuple[float, float] | None:
        """Where one more training would lie with 95 % probability, by Student's t; None of fewer than two."""
        n = len(self.values)
        if n < 2:
            return None
        half = float(student.ppf(0.975, n - 1)) * stdev(self.values) * (1.0 + 1.0 / n) ** 0.5
        return mean(self.values) - half, mean(self.values) + half

    def outside(self, value: float) -> bool:
        """Whether another policy's figure lies outside the interval; never without one."""
        return self.interval is not None and not self.interval[0] <= value <= self.interval[1]

    def text(self, digits: int = 3) -> str:
        """Mean, range and interval."""
        if not self.values:
            return "(not measured)"
        if self.interval is None:
            return f"{self.values[0]:.{digits}f} (one training)"
        spread = f"{min(self.values):.{digits}f} to {max(self.values):.{digits}f}"
        low, high = (f"{bound:.{digits}f}" for bound in self.interval)
        return f"{mean(self.values):.{digits}f} (range {spread}; interval {low} to {high})"
