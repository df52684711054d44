"""Shot: the circumstances of one exposure, when it looks at the sample, and the random numbers that belong to it."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from simulators.frame.detector import Detector

Image = NDArray[np.float64]
AngleAt = Callable[[float], float]


class CannotExposeError(ValueError):
    """The scene cannot be exposed in this way, though each of its values is legal; the message says what would help."""


@dataclass(frozen=True, eq=False)
class Shot:
    """The circumstances of one exposure.

    Attributes:
        detector: where the frame's pixels are (after ROI and binning).
        exposure: s.
        time: s since the Unix epoch, at the trigger.
        angle: true angle of the stage at the trigger, radians.
        angle_at: true angle of the stage in radians at a time in s; asked only by effects of motion.
        elapsed: s since the camera was connected; what drifts runs on it.
        row_period: s by which each row starts later than the one above.
        roi: (row0, col0, rows, cols) of the sensor.
        binning: sensor pixels summed per side.
        readout: the camera's mode: "standard", "ultra_quiet" or "photon_number".
        conversion: electrons a count.
        beam: the shutter is open (otherwise a dark).
        sample: the sample is in the beam (otherwise a flat).
        radius: mm from the rotation axis to the farthest matter of the sample.
        seed: of all random numbers.
        frame: number over the camera's life, whatever it shows.
        view: projections exposed before this frame.
    """

    detector: Detector
    exposure: float
    time: float
    angle: float
    angle_at: AngleAt
    elapsed: float
    row_period: float
    roi: tuple[int, int, int, int]
    binning: int
    readout: str
    conversion: float
    beam: bool
    sample: bool
    radius: float
    seed: int
    frame: int
    view: int

    def later(self, seconds: float) -> Shot:
        """The same shot as the sample is seen `seconds` after the trigger: at another time and angle."""
        if seconds == 0:
            return self
        time = self.time + seconds
        return replace(self, time=time, angle=self.angle_at(time))


@dataclass(frozen=True, eq=False)
class Moments:
    """When the rows of a frame see the sample.

    Attributes:
        times: float64 [moment, row], s after the trigger.
        weights: float64 [moment]; they sum to 1.
    """

    times: NDArray[np.float64]
    weights: NDArray[np.float64]

    @classmethod
    def at_trigger(cls, rows: int) -> Moments:
        return cls(np.zeros((1, rows)), np.ones(1))


def draws(effect: str, shot: Shot) -> np.random.Generator:
    """The generator of (seed, effect, frame): any frame can be made again alone, and an effect that is added changes
    no other's draw."""
    return np.random.default_rng([shot.seed, zlib.crc32(effect.encode()), shot.frame])


def lasting(effect: str, seed: int) -> np.random.Generator:
    """The generator of (effect, its own seed): of what stays from frame to frame.

    It is a branch of its own: without one, numpy takes (seed, effect) for (seed, effect, frame 0), as zeros at the end
    say nothing to it."""
    return np.random.default_rng(np.random.SeedSequence([seed, zlib.crc32(effect.encode())], spawn_key=(0,)))
