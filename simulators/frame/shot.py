"""Shot: the conditions of one exposure: rays of the frame, pose of the sample, times and random numbers."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.orca_quest import MODEL

Reals = NDArray[np.float64]
Image = NDArray[np.float64]
AngleAt = Callable[[float], float]


@dataclass(frozen=True)
class Detector:
    """Pixel (j, i) has the ray through u = (i - axis_col) * pitch, v = (j - axis_row) * pitch.

    Attributes:
        shape: (rows, cols).
        pitch: mm at the sample: in the plane of the rotation axis, for any magnification.
        axis_col: column of the rotation axis, 0 at the centre of the first column.
        axis_row: row of z = 0 (of the source's height in a cone), 0 at the centre of the first row.
        sod: mm from the source to the rotation axis; infinite for a parallel beam.
    """

    shape: tuple[int, int]
    pitch: float
    axis_col: float
    axis_row: float
    sod: float = math.inf

    def __post_init__(self) -> None:
        if not self.sod > 0:
            raise ValueError(f"sod must be positive in mm (infinite for a parallel beam), got {self.sod}")

    @classmethod
    def centred(cls, shape: tuple[int, int], pitch: float, sod: float = math.inf) -> Detector:
        """Rotation axis and z = 0 in the middle of the frame."""
        return cls(shape, pitch, (shape[1] - 1) / 2, (shape[0] - 1) / 2, sod)

    def aimed(self, row: float, col: float) -> Detector:
        """The rays at this offset, in pixels, from the rays through the middles of pixels."""
        return replace(self, axis_col=self.axis_col - col, axis_row=self.axis_row - row)

    def u(self) -> NDArray[np.float64]:
        return (np.arange(self.shape[1], dtype=np.float64) - self.axis_col) * self.pitch

    def v(self) -> NDArray[np.float64]:
        return (np.arange(self.shape[0], dtype=np.float64) - self.axis_row) * self.pitch


@dataclass(frozen=True, eq=False)
class Pose:
    """Rotation and displacement of the sample while each row is exposed. None: no displacement.

    The laboratory's axes are u (along the rows), b (along the beam, away from the source) and v (up the columns'
    index). A point p = (x, y, z) of the sample at angle θ is at u = x cos θ + y sin θ, b = y cos θ - x sin θ, v = z.
    The tilt rotates this point about the axes u and b of the laboratory through the origin, and the shift is added
    last.

    Attributes:
        angle: float64 [row], radians.
        shift: float64 [row, 3], mm along (u, b, v).
        tilt: float64 [row, 2], radians about (u, b); first about u, then about b.
    """

    angle: Reals
    shift: Reals | None = None
    tilt: Reals | None = None

    @classmethod
    def turned(cls, angle: ArrayLike, rows: int) -> Pose:
        """Rotation only; `angle` in radians, one for the frame or one per row [row]."""
        return cls(np.ascontiguousarray(np.broadcast_to(np.asarray(angle, dtype=np.float64), (rows,))))

    def turned_by(self, angle: ArrayLike) -> Pose:
        """The pose after a further rotation by `angle` radians, one for the frame or one per row."""
        return Pose(self.angle + np.asarray(angle, dtype=np.float64), self.shift, self.tilt)

    def shifted_by(self, shift: ArrayLike) -> Pose:
        """The pose after a further shift by `shift` mm, [3] or [row, 3]."""
        return Pose(self.angle, _added(self.shift, shift, (self.angle.size, 3)), self.tilt)

    def tilted_by(self, tilt: ArrayLike) -> Pose:
        """The pose after a further tilt by `tilt` radians, [2] or [row, 2]; small tilts add up, to second order."""
        return Pose(self.angle, self.shift, _added(self.tilt, tilt, (self.angle.size, 2)))

    def frames(self) -> tuple[Reals, Reals]:
        """The laboratory in the sample's coordinates.

        Returns:
            Axes float64 [row, 3, 3], whose columns are u, b and v in (x, y, z), and the laboratory's origin,
            float64 [row, 3] in mm.
        """
        zero, one = np.zeros_like(self.angle), np.ones_like(self.angle)
        c, s = np.cos(self.angle), np.sin(self.angle)
        to_lab = _matrices([[c, s, zero], [-s, c, zero], [zero, zero, one]])
        if self.tilt is not None:
            (cu, cb), (su, sb) = np.cos(self.tilt.T), np.sin(self.tilt.T)
            about_u = _matrices([[one, zero, zero], [zero, cu, -su], [zero, su, cu]])
            about_b = _matrices([[cb, zero, sb], [zero, one, zero], [-sb, zero, cb]])
            to_lab = about_b @ about_u @ to_lab
        axes = np.ascontiguousarray(to_lab.transpose(0, 2, 1))
        shift = np.zeros((c.size, 3)) if self.shift is None else self.shift
        return axes, -np.einsum("rij,rj->ri", axes, shift)


def _matrices(entries: list[list[Reals]]) -> Reals:
    """An array [row, 3, 3] from entries that are each [row]."""
    return np.moveaxis(np.array(entries), 2, 0)


def _added(present: Reals | None, more: ArrayLike, shape: tuple[int, int]) -> Reals:
    added: Reals = np.array(np.broadcast_to(np.asarray(more, dtype=np.float64), shape))
    return added if present is None else added + present


class CannotExposeError(ValueError):
    """The scene cannot be exposed, although each of its values is allowed. The message says what would help."""


@dataclass(frozen=True, eq=False)
class Shot:
    """The conditions of one exposure.

    Attributes:
        detector: the pixels of the frame (after ROI and binning). exposure: exposure time in s. time: time of the
            trigger, s since the Unix epoch.
        angle: radians, true angle of the stage at which a frame without effects of motion shows the sample.
        angle_at: function that returns the true angle of the stage in radians at a time in s; only effects of motion
            call it. elapsed: s since the camera was connected; the time of all drifts. row_period: s by which each row
            starts later than the row above. roi: (row0, col0, rows, cols) of the sensor. binning: number of sensor
            pixels summed per side. readout: mode of the camera: "standard", "ultra_quiet" or "photon_number".
            conversion: electrons per count. beam: True if the shutter is open (otherwise the frame is a dark). sample:
            True if the sample is in the beam (otherwise the frame is a flat). radius: mm from the rotation axis to the
            farthest material of the sample. seed: seed of all random numbers. frame: number of the frame since the
            camera was connected, of any kind. view: number of projections exposed before this frame. model: model of
            the camera. aside: mm by which the sample is moved sideways, towards higher columns.
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
    aside: float = 0.0

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
        """One moment for all rows, `seconds` after the trigger."""
        return cls(np.full((1, rows), seconds), np.ones(1))


def frame_rng(effect: str, shot: Shot) -> np.random.Generator:
    """The generator of (seed, effect, frame). With it any frame can be computed alone, and independently of other
    effects."""
    return np.random.default_rng([shot.seed, zlib.crc32(effect.encode()), shot.frame])


def fixed_rng(effect: str, seed: int) -> np.random.Generator:
    """The generator of (effect, seed of the effect), for everything that is the same in all frames.

    It has a spawn key: numpy ignores zeros at the end, so (seed, effect) would equal (seed, effect, frame 0)."""
    return np.random.default_rng(np.random.SeedSequence([seed, zlib.crc32(effect.encode())], spawn_key=(0,)))
