"""Hot pixels: a few sensor pixels whose dark current is far above the others'."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from drivers.orca_quest import SENSOR_SHAPE
from simulators.effects.domain import Domain
from simulators.effects.shot import Image, Shot, draws


@dataclass(frozen=True)
class HotPixels:
    """Pixels that stay where they are on the sensor, whatever the ROI.

    Attributes:
        fraction: of the sensor's pixels.
        rate: mean of their dark currents (exponentially distributed), electrons/s.
        seed: which pixels.
    """

    fraction: float = 1e-4
    rate: float = 2000.0
    seed: int = 0

    name: ClassVar[str] = "hot_pixels"
    domain: ClassVar[Domain] = Domain.ELECTRONS
    final: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if not (0 <= self.fraction <= 0.1 and self.rate >= 0):
            raise ValueError(f"fraction must lie in 0 ... 0.1 and rate be >= 0 electrons/s, got {self}")

    def apply(self, image: Image, shot: Shot) -> Image:
        rows, cols, rate = self.pixels()
        row0, col0, height, width = shot.roi
        seen = (rows >= row0) & (rows < row0 + height) & (cols >= col0) & (cols < col0 + width)
        rng = draws(self.name, shot)
        at = (rows[seen] - row0) // shot.binning, (cols[seen] - col0) // shot.binning
        np.add.at(image, at, rng.poisson(rate[seen] * shot.exposure))
        return image

    def pixels(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """Sensor rows, sensor columns and dark currents (electrons/s) of the hot pixels."""
        rng = np.random.default_rng(self.seed)
        n = round(self.fraction * SENSOR_SHAPE[0] * SENSOR_SHAPE[1])
        rows, cols = (rng.integers(extent, size=n) for extent in SENSOR_SHAPE)
        return rows, cols, rng.exponential(self.rate, n)
