"""Effects of the sensor's pixels: sensitivity, hot and dead pixels, zingers, and rows that are exposed one after the
other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.base.setting import setting
from simulators.effects.chain import ImageEffect, SamplingEffect
from simulators.frame.mapping import NotNegative, Positive, Share, Whole
from simulators.frame.shot import CannotExposeError, Image, Moments, Shot, frame_rng
from simulators.pixels.pattern import binned, normals, places


@dataclass(frozen=True)
class Prnu(ImageEffect):
    """The expected light times 1 + spread * a normal number of the sensor pixel, not below 0.

    It acts on the light, so that the photon noise remains Poisson. Name this effect after all effects that blur light.

    Attributes:
        spread: standard deviation as a share of the intensity; 1 % is typical of sensors (Janesick 2007, "Photon
            transfer"). It is assumed here, because the value of the ORCA-Quest is not published. seed: seed of the
            responses of pixels.
    """

    spread: float = setting(0.01, ge=0, le=0.2)
    seed: Whole = 0

    def apply(self, image: Image, shot: Shot) -> Image:
        gain = binned(normals(self.name, self.seed, shot), shot.binning)
        gain *= self.spread / shot.binning**2
        gain += 1.0
        np.maximum(gain, 0.0, out=gain)
        gain *= image
        return gain


@dataclass(frozen=True)
class HotPixels(ImageEffect):
    """The same pixels of the sensor in every frame, for any ROI.

    Attributes:
        fraction: fraction of the sensor's pixels.
        rate: mean of their dark currents (exponentially distributed), electrons/s.
        seed: seed of their positions and dark currents.
    """

    fraction: float = setting(1e-4, ge=0, le=0.1)
    rate: float = setting(2000.0, ge=0, le=1e9)
    seed: Whole = 0

    def apply(self, image: Image, shot: Shot) -> Image:
        pixels, even = places(self.name, self.seed, self.fraction, shot)
        rates = -self.rate * np.log1p(-even)
        np.add.at(image, pixels, frame_rng(self.name, shot).poisson(rates * shot.exposure))
        return image


@dataclass(frozen=True)
class DeadPixels(ImageEffect):
    """The same pixels of the sensor in every frame. Name this effect after all effects that add charge and before the
    read noise, because dead pixels have read noise like others. A binned pixel loses the share of its dead pixels.

    Attributes:
        fraction: fraction of the sensor's pixels.
        charge: number of electrons in them: 0, or 7000 for pixels that are stuck at the full well.
        seed: seed of their positions.
    """

    fraction: float = setting(1e-4, ge=0, le=0.1)
    charge: NotNegative = 0.0
    seed: Whole = 0

    def apply(self, image: Image, shot: Shot) -> Image:
        drawn, _ = places(self.name, self.seed, self.fraction, shot)
        pixels, times = np.unique(np.ravel_multi_index(drawn, image.shape), return_counts=True)
        flat = image.reshape(-1)
        flat[pixels] = flat[pixels] * (1 - times / shot.binning**2) + times * self.charge
        return image


DROPS = 200  # number of parts into which a spread charge is divided
MOST = 100_000  # Largest number of zingers in a frame, because the work grows with this number


@dataclass(frozen=True)
class Zingers(ImageEffect):
    """Bright pixels at random places; some may be tracks, and their charge may be spread.

    Attributes:
        rate: mean number of zingers per second in the frame. charge: mean number of electrons of a zinger
            (exponentially distributed).
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
        """Raises CannotExposeError if a frame has more than MOST zingers, because then the units are probably wrong."""
        rng = frame_rng(self.name, shot)
        expected = self.rate * shot.exposure
        if expected > MOST:
            raise CannotExposeError(
                f"zingers: {self.rate:g} per second are {expected:.3g} in a frame of {shot.exposure:g} s, "
                f"above the limit of {MOST}; the rate counts the zingers of the whole frame"
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


@dataclass(frozen=True)
class RollingShutter(SamplingEffect):
    """The sensor reads its rows in pairs, one pair in each line time, downwards from the first row of the frame.

    A line time is two row periods of the sensor: 7.2 us in the standard readout and 172.8 us in ultra quiet (property
    table of the C15550-20UP). A binned row begins with its first line. Every row is exposed for the same time from its
    own start, as with an edge trigger that opens the rows one after the other. Modes that expose all rows together
    are not simulated: DELAYED, which waits for light until the last row is open, and GLOBALRESET, which opens
    all rows together and closes them line by line.
    """

    def moments(self, moments: Moments, shot: Shot) -> Moments:
        lines = np.arange(moments.times.shape[1]) * shot.binning // 2
        return Moments(moments.times + lines * (2 * shot.row_period / shot.binning), moments.weights)
