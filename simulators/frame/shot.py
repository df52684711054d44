"""Shot: the conditions of one exposure, its moments, and its random numbers."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drivers.orca_quest import MODEL
from simulators.frame.detector import Detector

Image = NDArray[np.float64]
AngleAt = Callable[[float], float]


class CannotExposeError(ValueError):
    """The scene cannot be exposed, though each of its values is legal; the message says what would help."""


@dataclass(frozen=True, eq=False)
class Shot:
    """The conditions of one exposure.

    Attributes:
        detector: the frame's pixels (after ROI and binning).
        exposure: s.
        time: s since the Unix epoch, at the trigger.
        angle: true angle of the stage where a frame without effects of motion is exposed, radians.
        angle_at: true angle of the stage in radians at a time in s; called by effects of motion only.
        elapsed: s since the camera was connected; the time of all drifts.
        row_period: s by which each row starts later than the one above.
        roi: (row0, col0, rows, cols) of the sensor.
        binning: sensor pixels summed per side.
        readout: the camera's mode: "standard", "ultra_quiet" or "photon_number".
        conversion: electrons a count.
        beam: the shutter is open (otherwise a dark).
        sample: the sample is in the beam (otherwise a flat).
        radius: mm from the rotation axis to the farthest matter of the sample.
        seed: of all random numbers.
        frame: number since the camera was connected, of any kind.
        view: projections exposed before this frame.
        model: of the camera.
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
    model: str = MODEL

    def later(self, seconds: float) -> Shot:
        """The same shot with time and angle `seconds` after the trigger."""
        if seconds == 0:
            return self
        time = self.time + seconds
        return replace(self, time=time, angle=self.angle_at(time))


@dataclass(frozen=True, eq=False)
class Moments:
    """The times at which the rows of a frame sample the exposure.

    Attributes:
        times: float64 [moment, row], s after the trigger.
        weights: float64 [moment]; they sum to 1.
    """

    times: NDArray[np.float64]
    weights: NDArray[np.float64]

    @classmethod
    def once(cls, rows: int, seconds: float = 0.0) -> Moments:
        """All rows so long after the trigger."""
        return cls(np.full((1, rows), seconds), np.ones(1))


def frame_rng(effect: str, shot: Shot) -> np.random.Generator:
    """The generator of (seed, effect, frame): any frame can be computed alone, whatever the other effects."""
    return np.random.default_rng([shot.seed, zlib.crc32(effect.encode()), shot.frame])


def fixed_rng(effect: str, seed: int) -> np.random.Generator:
    """The generator of (effect, its own seed), for all that is the same in every frame.

    It has a spawn key: numpy ignores zeros at the end, so (seed, effect) would equal (seed, effect, frame 0)."""
    return np.random.default_rng(np.random.SeedSequence([seed, zlib.crc32(effect.encode())], spawn_key=(0,)))
