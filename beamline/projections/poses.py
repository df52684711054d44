"""Poses: the displacement, roll and tilt of the views of a scan that a file states, as geometry."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError, DataError
from beamline.core.text import count
from beamline.projections.corrections.calibrate import Calibrate
from beamline.projections.corrections.poses import stated_poses
from beamline.projections.corrections.resampling import TiltAndLens
from beamline.projections.protocols import RayStep
from beamline.projections.registry import in_order
from beamline.projections.selection import Selection, choose_views, cone_of, geometry_of, pixel_size, rows_of
from beamline.projections.step import StepDone
from beamline.storage.pose_table import PoseTable
from beamline.storage.readers.base import ScanSource
from drivers.base.frame import FrameKind
from recon.base.arrays import F64, I64
from recon.base.geometry import Geometry

_OFF = 0.25  # of the step between two views: an angle that differs by more belongs to another view


@dataclass(frozen=True, eq=False)
class ScanPoses:
    """Poses of the frames of a scan.

    Attributes:
        shifts: float64 [frame, 2], (col, row) in pixels of the unbinned detector, NaN where the file states none.
        roll, tilt: float64 [frame], radians.
        frames: int64 [view], the rows that are used.
        said: in a line, what was read.
        pivot: row of the detector, binned and counted from the first one used, that views are rolled and tilted about.
        binning: of the detector's pixels.
    """

    shifts: F64
    roll: F64
    tilt: F64
    frames: I64
    said: str
    pivot: float
    binning: int

    @property
    def done(self) -> StepDone:
        return StepDone(self.said)

    def known(self, view_ids: I64) -> NDArray[np.bool_]:
        """[view] whether the file states their pose."""
        return np.isfinite(self.roll[view_ids])

    def corrected(self, geometry: Geometry, view_ids: I64) -> Geometry:
        """The geometry of these rows of the file in their poses."""
        posed = replace(
            geometry,
            shifts=geometry.shifts + self.shifts[view_ids] / self.binning,
            roll=geometry.roll + self.roll[view_ids],
            tilt=geometry.tilt + self.tilt[view_ids],
        )
        return about(posed, self.pivot)


def stated_geometry(source: ScanSource, selection: Selection) -> Geometry:
    """The views that the selection names, as scan and options state them, before any frame is read.

    An axis that is to be found is taken in the middle; views without an angle or a pose are left out.

    Raises:
        ConfigError: the selection does not fit the scan.
        DataError: the poses do not fit the scan.
    """
    frames = np.flatnonzero((source.image_key == FrameKind.PROJECTION) & np.isfinite(source.angles))
    poses = poses_of(source, selection, frames)
    if poses is not None:
        frames = frames[poses.known(frames)]
    frames = frames[choose_views(source, frames, selection)]
    stated = source.axis_col if selection.axis_col is None else selection.axis_col
    axis_col = (source.shape[1] - 1) / 2 if stated is None else stated
    geometry = geometry_of(source, selection, axis_col, source.angles[frames])
    if poses is not None:
        geometry = poses.corrected(geometry, frames)
    for step in in_order(selection):
        if isinstance(step, RayStep):
            geometry, _ = step.rays(source, selection, geometry)
    return geometry


def pivot_of(source: ScanSource, selection: Selection) -> float:
    """The middle row of the detector, binned and counted from the first row used."""
    middle, binning = (source.shape[0] - 1) / 2, selection.binning
    return (middle - rows_of(source, selection).start - (binning - 1) / 2) / binning


def about(geometry: Geometry, pivot: float) -> Geometry:
    """The geometry whose views roll and tilt about this row."""
    # A parallel beam's z = 0 is the middle of its rows, but those views lean about the detector's middle.
    return geometry if geometry.is_straight or geometry.is_cone else replace(geometry, axis_row=pivot)


def poses_of(source: ScanSource, selection: Selection, frames: I64) -> ScanPoses | None:
    """The poses that the selection's file states of `frames`, or the scan file itself; None without any.

    Raises:
        ConfigError: options that do not go together.
        DataError: the file does not fit the scan: the message says how.
    """
    table = stated_poses(source, selection)
    if table is None:
        return None
    tilt = selection.step(TiltAndLens)
    if tilt.sought or tilt.tilt_deg:
        raise ConfigError(
            f"--tilt turns views that {table.path} states as they were taken: write it to the roll_deg of --poses."
        )
    if selection.step(Calibrate).geometry:
        raise ConfigError(
            f"--calibrate learns what {table.path} states: give one of --calibrate and --poses, or --poses ignore."
        )
    shifts = table.shifts * _pixels(table, source, selection)
    rows = _rows(table, source, frames)
    height, width = source.shape
    if (far := (np.abs(shifts) >= (width, height)).any(axis=1)).any():
        row = int(np.flatnonzero(far)[0])
        raise DataError(
            f"{table.path}: {table.by} {table.keys[row]:g} is displaced by {shifts[row, 0]:g} columns and "
            f"{shifts[row, 1]:g} rows on a detector of {width} x {height}; expected pixels of the unbinned detector."
        )
    n = source.image_key.size
    every = np.full((n, 4), np.nan)
    every[rows >= 0] = np.column_stack((shifts, np.radians(table.turns_deg)))[rows[rows >= 0]]
    pivot, said = pivot_of(source, selection), _said(table, shifts)
    return ScanPoses(every[:, :2], every[:, 2], every[:, 3], frames, said, pivot, selection.binning)


def _pixels(table: PoseTable, source: ScanSource, selection: Selection) -> float:
    """Pixels of the unbinned detector in the table's unit."""
    if table.unit == "px":
        return 1.0
    if cone_of(source, selection) is not None:
        raise DataError(
            f"{table.path}: translations of the sample in mm are no shifts of a cone's views, whose matter is "
            "magnified by its depth. Give a CSV of shifts in pixels. Nothing was read."
        )
    size = pixel_size(source, selection)
    if size is None:
        raise DataError(f"{table.path} is in mm, and {source.path} does not say its pixel size: give --pixel-size-um.")
    return 1 / size


def _rows(table: PoseTable, source: ScanSource, frames: I64) -> I64:
    """[frame of the scan] its row in the table; -1: none. Angles that both state must agree."""
    n, views = source.image_key.size, np.flatnonzero(source.image_key == FrameKind.PROJECTION)
    if table.frames is not None and table.frames != n:
        raise DataError(f"{table.path} has {table.frames} frames, {source.path} has {n}; expected the same scan.")
    found, degrees = np.full(n, -1, np.int64), np.degrees(source.angles)
    distances = np.diff(np.unique(np.round(degrees[frames], 9)))
    tolerance = _OFF * (float(np.median(distances)) if distances.size else 1.0)
    if table.by == "angle_deg":
        order = np.argsort(table.keys)
        ordered = table.keys[order]
        right = np.clip(np.searchsorted(ordered, degrees[views]), 0, ordered.size - 1)
        left = np.maximum(right - 1, 0)
        wanted = degrees[views]
        nearest = np.where(np.abs(ordered[left] - wanted) < np.abs(ordered[right] - wanted), left, right)
        close = np.abs(ordered[nearest] - wanted) <= tolerance
        found[views[close]] = order[nearest[close]]
    else:
        into = views if table.by == "view" else np.arange(n)
        if (beyond := table.keys >= into.size).any():
            raise DataError(
                f"{table.path} states {table.by} {table.keys[beyond][0]:g}; {source.path} has {into.size} {table.by}s, "
                "counted from 0."
            )
        found[into[table.keys.astype(np.int64)]] = np.arange(table.keys.size)
        if table.angles_deg is not None:
            both = frames[found[frames] >= 0]
            off = np.abs(table.angles_deg[found[both]] - degrees[both])
            if (off > tolerance).any():
                at = int(both[off > tolerance][0])
                raise DataError(
                    f"{table.path} states frame {at} at {table.angles_deg[found[at]]:.6g} degrees, {source.path} at "
                    f"{degrees[at]:.6g}; expected the poses of the same scan."
                )
    return found


def require_known(poses: ScanPoses, source: ScanSource, selection: Selection, view_ids: I64) -> None:
    """DataError where views have no pose."""
    unknown, table = view_ids[~poses.known(view_ids)], stated_poses(source, selection)
    if unknown.size and table is not None:
        degrees = np.degrees(source.angles[unknown[0]])
        raise DataError(
            f"{table.path} states no pose of {unknown.size} of the {view_ids.size} views chosen of {source.path} "
            f"(the first: frame {unknown[0]}, at {degrees:.6g} degrees). Add them, or choose the others with --views."
        )


def _said(table: PoseTable, shifts: F64) -> str:
    across, down = np.ptp(shifts, axis=0)
    roll, tilt = np.abs(table.turns_deg).max(axis=0)
    return (
        f"{count(table.keys.size, 'pose')} from {table.path}: shifts over {across:.3g} px (columns) and {down:.3g} px "
        f"(rows), roll up to {roll:.3g}° and tilt up to {tilt:.3g}°."
    )
