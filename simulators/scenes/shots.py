"""Shots: the frames of a scan by the scene's own settings: darks, flats, then views."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from drivers.base.frame import FrameKind
from drivers.orca_quest import LINE_TIME, SENSOR_SHAPE
from simulators.frame.detector import Detector
from simulators.frame.sensor import CONVERSION
from simulators.frame.shot import AngleAt, Shot
from simulators.scenes.scene import Scene


@dataclass(frozen=True, eq=False)
class PlannedFrame:
    """A frame of a scan, computed alone and in any order by `expose(scene, shot)`."""

    kind: FrameKind
    shot: Shot


@dataclass(frozen=True, eq=False)
class Scan:
    """A scan of a scene. Created by `Scan.of`.

    Attributes:
        seed: of all random numbers.
        start: s since the Unix epoch, of the first frame.
        views: number of projections, spread over the scene's range. In a fly scan fewer views have longer periods:
        the speed of the stage stays, so that each view has the scene's blur.
    """

    scene: Scene
    seed: int
    start: float
    views: int

    @classmethod
    def of(cls, scene: Scene, seed: int = 0, views: int | None = None, start: float = 0.0) -> Scan:
        """`views` in place of the scene's number. Raises ValueError where it is less than one."""
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
        """s from one trigger to the next."""
        settings = self.scene.scan
        return settings.period_s * (max(settings.views / self.views, 1.0) if settings.fly else 1.0)

    def angle(self, view: int) -> float:
        """Radians at the trigger of a view."""
        return math.radians(self.scene.scan.range_deg) * view / self.views

    def frame(self, number: int) -> PlannedFrame:
        """Frame `number` of 0 ... len - 1.

        Raises:
            IndexError: there is no such frame.
        """
        if not 0 <= number < len(self):
            raise IndexError(f"frame {number} is not one of the scan's 0 ... {len(self) - 1}")
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
