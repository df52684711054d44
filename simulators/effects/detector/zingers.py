"""Zingers: stray X-rays and muons hit the sensor directly and leave bright pixels in a single frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simulators.effects.chain import ImageEffect
from simulators.frame.mapping import NotNegative, Positive, Share
from simulators.frame.shot import CannotExposeError, Image, Shot, frame_rng

DROPS = 200  # Number of parts into which a spread charge is split
MOST = 100_000  # Largest number of zingers in a frame; the work grows with it


@dataclass(frozen=True)
class Zingers(ImageEffect):
    """Bright pixels at random places; some may be tracks, and their charge may be spread.

    Attributes:
        rate: mean number a second in the frame.
        charge: mean electrons of a zinger (exponentially distributed).
        tracks: share of zingers that run along the sensor, in any direction.
        length: mean length of a track (exponentially distributed), pixels of the frame.
        radius: standard deviation of the charge around its point or track, pixels of the frame; 0: a single pixel.
    """

    rate: NotNegative
    charge: Positive = 3000.0
    tracks: Share = 0.0
    length: Positive = 20.0
    radius: NotNegative = 0.0

    def apply(self, image: Image, shot: Shot) -> Image:
        """Raises CannotExposeError if a frame has more than MOST: the units are probably wrong."""
        rng = frame_rng(self.name, shot)
        expected = self.rate * shot.exposure
        if expected > MOST:
            raise CannotExposeError(
                f"zingers: {self.rate:g} a second are {expected:.3g} in a frame of {shot.exposure:g} s, above the "
                f"limit of {MOST}; a rate counts the zingers of the whole frame"
            )
        n = int(rng.poisson(expected))
        where = np.array(np.unravel_index(rng.integers(image.size, size=n), image.shape), dtype=np.float64)
        charge = rng.exponential(self.charge, n)
        if self.tracks > 0 or self.radius > 0:
            where, charge = self._spread(where, charge, rng)
        row, col = np.rint(where).astype(np.int64)
        inside = (row >= 0) & (row < image.shape[0]) & (col >= 0) & (col < image.shape[1])
        np.add.at(image, (row[inside], col[inside]), charge[inside])
        return image

    def _spread(self, where: Image, charge: Image, rng: np.random.Generator) -> tuple[Image, Image]:
        """Each charge split into DROPS parts along and around its track: places [2, part] and charges [part]."""
        n = charge.size
        runs = rng.random(n) < self.tracks
        length, heading = rng.exponential(self.length, n) * runs, rng.uniform(0, 2 * np.pi, n)
        ends = np.stack([length * np.sin(heading), length * np.cos(heading)])
        parts = where[:, :, None] + ends[:, :, None] * (np.arange(DROPS) / DROPS)
        parts += self.radius * rng.standard_normal(parts.shape)
        return parts.reshape(2, -1), np.repeat(charge / DROPS, DROPS)
