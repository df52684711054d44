"""Scatter: the usual variation of a figure, below which no limit may lie; and a running mean of frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CALIBRATION = 12  # figures before the scatter means anything
MEMORY = 0.02  # weight of the newest figure
NORMAL = 1.2533  # standard deviation of a normal distribution over its mean absolute deviation: sqrt(pi / 2)
OUTLIER = 4.0  # mean absolute deviations that a single figure may add


@dataclass(frozen=True)
class FrameScatter:
    """Running mean and mean absolute deviation; a single outlier moves them by no more than four deviations' worth."""

    n: int = 0
    mean: float = 0.0
    deviation: float = 0.0

    @property
    def ready(self) -> bool:
        return self.n >= CALIBRATION

    @property
    def sigma(self) -> float:
        return NORMAL * self.deviation

    def with_figure(self, figure: float) -> FrameScatter:
        weight = max(MEMORY, 1 / (self.n + 1))
        away = figure - self.mean
        if self.ready and abs(away) > OUTLIER * self.deviation:
            away = OUTLIER * self.deviation if away > 0 else -OUTLIER * self.deviation
        return FrameScatter(
            self.n + 1, self.mean + weight * away, self.deviation + weight * (abs(away) - self.deviation)
        )


def running_mean(so_far: NDArray[np.float32] | None, newest: NDArray[np.float32], n: int) -> NDArray[np.float32]:
    """The mean of n arrays, from that of n - 1 and the n-th."""
    return newest if so_far is None or n == 1 else so_far + (newest - so_far) / np.float32(n)
