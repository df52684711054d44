"""Exposures of a scene: a single frame, and all frames of a scan with the scene's own settings.

A frame is computed from the rotating sample to the counts. Only the effects that the scene names are applied. A scan
has darks, then flats, then projections.

Without effects a frame is photons x exposure x exp(-line integral) / conversion, rounded: Beer-Lambert.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drivers.base.frame import FrameKind
from drivers.orca_quest import LINE_TIME, SENSOR_SHAPE
from simulators.effects.catalogue import Domain
from simulators.frame.sensor import CONVERSION, digitise, largest_count
from simulators.frame.shot import AngleAt, Detector, Image, Pose, Shot
from simulators.samples.sample import sample_at
from simulators.scenes.scene import Scene


@dataclass(frozen=True, eq=False)
class PlannedFrame:
    """A frame of a scan. `expose(scene, shot)` computes frames alone and in any order."""

    kind: FrameKind
    shot: Shot


@dataclass(frozen=True, eq=False)
class Scan:
    """A scan of a scene. Created by `Scan.of`.

    Attributes:
        seed: seed of all random numbers. start: time of the first frame, s since the Unix epoch. views: number of
            projections, spread over the range of the scene. In a fly scan with fewer projections, periods are longer.
            The speed of the stage does not change, so each projection has the blur of the scene.
    """

    scene: Scene
    seed: int
    start: float
    views: int

    @classmethod
    def of(cls, scene: Scene, seed: int = 0, views: int | None = None, start: float = 0.0) -> Scan:
        """`views` replaces the number in the scene. Raises ValueError if `views` is below one."""
        if views is not None and views < 1:
            raise ValueError(f"a scan needs at least one view, got {views}")
        return cls(scene, seed, start, scene.scan.views if views is None else views)

    def __len__(self) -> int:
        return self.scene.scan.darks + self.scene.scan.flats + self.views

    @property
    def detector(self) -> Detector:
        """The frame's pixels, in the middle of the sensor."""
        settings = self.scene.detector
        rows, cols = settings.shape
        return Detector(
            shape=settings.shape,
            pitch=settings.pixel_size_um * 1e-3 * settings.binning,
            axis_col=(cols - 1) / 2 + self.scene.axis_offset_px / settings.binning,
            axis_row=(rows - 1) / 2,
            sod=self.scene.beam.source_distance,
        )

    @property
    def roi(self) -> tuple[int, int, int, int]:
        """(row0, col0, rows, cols) of the sensor."""
        rows, cols = (n * self.scene.detector.binning for n in self.scene.detector.shape)
        return (SENSOR_SHAPE[0] - rows) // 2, (SENSOR_SHAPE[1] - cols) // 2, rows, cols

    @property
    def period(self) -> float:
        """Time in s from one trigger to the next."""
        settings = self.scene.scan
        return settings.period_s * (max(settings.views / self.views, 1.0) if settings.fly else 1.0)

    def angle(self, view: int) -> float:
        """Angle in radians at the trigger of a projection."""
        return math.radians(self.scene.scan.range_deg) * view / self.views

    def frame(self, number: int) -> PlannedFrame:
        """Frame `number` of 0 ... len - 1.

        Raises:
            IndexError: there is no such frame.
        """
        if not 0 <= number < len(self):
            raise IndexError(f"frame {number} is not in the scan, which has 0 ... {len(self) - 1}")
        settings, scan = self.scene.detector, self.scene.scan
        view = number - scan.darks - scan.flats
        beam, sample = number >= scan.darks, view >= 0
        kind = FrameKind.PROJECTION if sample else FrameKind.FLAT if beam else FrameKind.DARK
        time = self.start + number * self.period
        angle = self.angle(max(view, 0))
        shot = Shot(
            detector=self.detector,
            exposure=settings.exposure_s,
            time=time,
            angle=angle,
            angle_at=self._stage(time, angle, turns=sample and scan.fly),
            elapsed=number * self.period,
            row_period=LINE_TIME[settings.readout] / 2 * settings.binning,
            roi=self.roi,
            binning=settings.binning,
            readout=settings.readout,
            conversion=settings.electrons_per_count or CONVERSION[settings.readout],
            beam=beam,
            sample=sample,
            radius=self.scene.sample.radius,
            seed=self.seed,
            frame=number,
            view=max(view, 0),
        )
        return PlannedFrame(kind, shot)

    def __iter__(self) -> Iterator[PlannedFrame]:
        return (self.frame(number) for number in range(len(self)))

    def _stage(self, time: float, angle: float, turns: bool) -> AngleAt:
        speed = math.radians(self.scene.scan.range_deg) / self.views / self.period if turns else 0.0
        return lambda at: angle + speed * (at - time)


def expose(scene: Scene, shot: Shot) -> NDArray[np.uint16]:
    """One frame, counts uint16 [row, col].

    Args:
        shot: the conditions; the same shot gives the same frame.
    """
    chain = scene.chain
    if shot.beam:
        photons = _photons(scene, shot)
        electrons = chain.apply(Domain.PHOTONS, photons, shot)
    else:
        electrons = np.zeros(shot.detector.shape)
    electrons = chain.apply(Domain.ELECTRONS, electrons, shot)
    electrons /= shot.conversion
    counts = chain.apply(Domain.COUNTS, electrons, shot)
    return digitise(counts, largest_count(shot.readout, shot.binning))


def _photons(scene: Scene, shot: Shot) -> Image:
    """Photons behind the sample, averaged over the moments of the effects of motion; float64 [row, col]."""
    open_beam = scene.beam.photons_per_s * shot.exposure * shot.binning**2  # photons of a pixel
    if not shot.sample:
        return np.full(shot.detector.shape, open_beam)
    if not scene.chain.moves:
        angle = np.full(shot.detector.shape[0], shot.angle)
        return _transmission(scene, shot, angle, np.zeros_like(angle), open_beam)
    moments = scene.chain.moments(shot)
    parts = (
        _transmission(scene, shot, _row_angles(times, shot), times, weight * open_beam)
        for times, weight in zip(moments.times, moments.weights, strict=True)
    )
    photons = next(parts)
    for part in parts:
        photons += part
    return photons


def _transmission(
    scene: Scene,
    shot: Shot,
    angles: NDArray[np.float64],
    times: NDArray[np.float64],
    open_beam: float,
) -> Image:
    """The intensity open_beam x exp(-line integral), with the pose of the sample at one moment for each row, averaged
    over the rays of a pixel.
    """
    pose = scene.chain.pose(Pose(angles), times, shot)
    pose = pose.shifted_by((shot.aside, 0.0, 0.0)) if shot.aside else pose
    now, rays = shot.later(float(times[0])), scene.chain.rays
    sample = sample_at(scene.sample, shot.elapsed + float(times[0]))

    def through(row: float, col: float) -> Image:
        detector = shot.detector.aimed(row, col)
        depth = sample.line_integrals(pose, detector)
        depth = scene.chain.apply(Domain.OPTICAL_DEPTH, depth, replace(now, detector=detector))
        np.exp(np.negative(depth, out=depth), out=depth)
        depth *= open_beam / len(rays)
        return depth

    photons = through(*rays[0])
    for ray in rays[1:]:
        photons += through(*ray)
    return photons


def _row_angles(times: NDArray[np.float64], shot: Shot) -> NDArray[np.float64]:
    """Angles of the rows at `times` after the trigger, float64 [row].

    Only the angles of the first and the last row are read: within the milliseconds of a readout the angle is linear to
    1e-5 rad even while the stage accelerates at 1 rad/s2.
    """
    first, last = shot.angle_at(shot.time + times[0]), shot.angle_at(shot.time + times[-1])
    span = times[-1] - times[0]
    return first + (last - first) * (times - times[0]) / (span if span > 0 else 1.0)
