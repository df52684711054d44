"""Poses of projections from a file (displacement, roll and tilt, or vectors) become a part of the geometry. Projections
are not resampled.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from beamline.core.errors import ConfigError, DataError
from beamline.core.text import count
from beamline.projections.corrections.resampling import TiltAndLens
from beamline.projections.protocols import ScanPart, Unmoved, ViewMotion
from beamline.projections.registry import geometry_steps
from beamline.projections.selection import SelectedScan, with_pivot
from beamline.projections.step import StepDone, StepMemory, option

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from beamline.projections.usable_views import UsableViews
    from beamline.storage.pose_table import PoseTable
    from beamline.storage.readers.base import ScanSource
    from recon.base.arrays import F64, I64
    from recon.base.geometry import Geometry

_SAME_SIZE = 0.01  # share of a pixel
# share of the step between two projections: an angle that differs by more belongs to another projection
_ANGLE_TOLERANCE = 0.25


def _table(text: str) -> PoseTable:
    from beamline.storage.pose_table import read_poses

    return read_poses(text)


@dataclass(frozen=True)
class PosesOfFile:
    """Displacement, roll and tilt of the projections, as stated by a file.

    Attributes:
        table: the poses in the file of the option; None: projections are displaced as the scan file states (.txrm), or
            not at all.
    """

    name: ClassVar[str] = "poses"
    follows: ClassVar[tuple[str, ...]] = ("tilt", "phase", "jumps")
    table: PoseTable | None = option(
        "--poses",
        None,
        "Displacement, roll and tilt of each projection; no projection is resampled. FILE is one of these. (1) "
        "A CSV with the columns view or angle_deg, and shift_col_px, shift_row_px, roll_deg, tilt_deg. (2) A "
        "volume that has poses. (3) An NXtomo file as FILE:x,-y, where x means that a positive x_translation "
        "shifts the sample towards higher columns, and -y means that a positive y_translation shifts the sample "
        "towards lower rows. (4) The vectors of ASTRA for each projection, in mm: a CSV with the twelve columns "
        "ray_x (in a cone beam src_x) to v_z, or an .npz with parallel3d_vec or cone_vec. ignore: do not use the "
        "shifts that a .txrm states.",
        parse=_table,
        metavar="FILE",
    )

    @property
    def needs_finished(self) -> str:
        return "" if self.table is None else "--poses needs a finished scan, because it uses all projections."

    def memory(self, part: ScanPart) -> StepMemory:
        return StepMemory()

    def place(
        self,
        scan: SelectedScan,
        usable: UsableViews,
        axis_col: float,
        progress: Callable[[int, int], None],
    ) -> ViewMotion:
        return poses_of(scan, usable.frames) or Unmoved(usable.frames)


def stated_poses(scan: SelectedScan) -> PoseTable | None:
    """The poses in the file of the option; without the option, the shifts in the scan file."""
    from beamline.storage.pose_table import PoseTable

    source = scan.source
    table, shifts = scan.selection.step(PosesOfFile).table, source.table.shifts
    if table is not None:
        return table if table.keys.size else None
    if shifts is None:
        return None
    rows = np.flatnonzero(np.isfinite(shifts).all(axis=1))
    frames = rows.astype(np.float64)
    return PoseTable(source.path, "frame", frames, None, shifts[rows], np.zeros((rows.size, 2)), frames=len(shifts))


@dataclass(frozen=True, eq=False)
class ScanPoses:
    """Poses of the frames of a scan.

    Attributes:
        table: the poses as the file states them.
        shifts: float64 [frame, 2], (col, row) in pixels of the unbinned detector; NaN for a frame without a stated
            shift.
        roll, tilt: float64 [frame], radians.
        frames: int64 [view], the rows that are used.
        sentence: a sentence that says what was read.
        pivot: row of the detector about which projections are rolled and tilted, binned and counted from the first
            one used.
        binning: binning of the detector's pixels.
        vectors: the geometry that the file states for its projections, in the rows and with the binning used; None:
            the file has no vectors.
        view_of: int64 [frame], index of the frame in `vectors`; -1: the frame has no vector.
    """

    table: PoseTable
    shifts: F64
    roll: F64
    tilt: F64
    frames: I64
    sentence: str
    pivot: float
    binning: int
    vectors: Geometry | None = None
    view_of: I64 = field(default_factory=lambda: np.empty(0, np.int64))

    @property
    def axis_col(self) -> float:
        """The full-detector column of the axis according to the pose vectors, or the nearest column."""
        assert self.vectors is not None
        whole = self.binning * self.vectors.detector_shape[1]
        return float(np.clip(self.binning * self.vectors.axis_col + (self.binning - 1) / 2, 0, whole - 1))

    @property
    def done(self) -> StepDone:
        return StepDone(self.sentence)

    def stated(self, view_ids: I64) -> NDArray[np.bool_]:
        """[view] True if the file states the pose of the projection."""
        return np.isfinite(self.roll[view_ids])

    def corrected(self, geometry: Geometry, view_ids: I64) -> Geometry:
        """The geometry of these rows of the file with their poses applied."""
        if self.vectors is not None:
            return self.vectors.select(self.view_of[view_ids])
        posed = replace(
            geometry,
            shifts=geometry.shifts + self.shifts[view_ids] / self.binning,
            roll=geometry.roll + self.roll[view_ids],
            tilt=geometry.tilt + self.tilt[view_ids],
        )
        return with_pivot(posed, self.pivot)


def poses_of(scan: SelectedScan, frames: I64) -> ScanPoses | None:
    """The poses of all frames of the scan, NaN for a frame without a pose: from the file of --poses, otherwise from the
    scan file. None if neither states poses, or with --poses ignore.

    Args:
        frames: int64 [view], the frames that are used.

    Raises:
        ConfigError: options exclude each other.
        DataError: the file does not fit the scan; the message says why.
    """
    table, source, selection = stated_poses(scan), scan.source, scan.selection
    if table is None:
        return None
    tilt = selection.step(TiltAndLens)
    if tilt.sought or tilt.tilt_deg:
        raise ConfigError(
            "--tilt and --poses both set the roll of the projections. Omit --tilt, and add the tilt to the column "
            f"roll_deg of {table.path}."
        )
    for option_name in (step.requested_by for step in geometry_steps(selection) if step.geometry):
        raise ConfigError(
            f"{option_name} determines from the projections what {table.path} already states. Give either "
            f"{option_name} or --poses. To omit the shifts that the scan states, add --poses ignore."
        )
    shifts = table.shifts * _pixels_per_unit(table, scan)
    table_rows = _rows_of_frames(table, source, frames)
    height, width = source.shape
    # the displacement of offset projections is at most a few fields of view
    if (too_far := (np.abs(shifts) >= (8 * width, height)).any(axis=1)).any():
        row = int(np.flatnonzero(too_far)[0])
        projection = table.keys[row]
        shift_cols = shifts[row, 0]
        shift_rows = shifts[row, 1]
        raise DataError(
            f"{table.path}: {table.by} {projection:g} is displaced by {shift_cols:g} columns and {shift_rows:g} "
            f"rows, but the detector has {width} x {height} pixels. Expected displacements in pixels of the unbinned "
            "detector."
        )
    n = len(source.table)
    pose_of_frame = np.full((n, 4), np.nan)
    has_pose = table_rows >= 0
    pose_of_frame[has_pose] = np.column_stack((shifts, np.radians(table.turns_deg)))[table_rows[has_pose]]
    pivot, sentence = selection.pivot, _sentence(table, shifts)
    poses = ScanPoses(
        table,
        pose_of_frame[:, :2],
        pose_of_frame[:, 2],
        pose_of_frame[:, 3],
        frames,
        sentence,
        pivot,
        selection.binning,
    )
    if table.vectors is None:
        return poses
    return replace(poses, vectors=_of_vectors(table, scan), view_of=table_rows)


def _of_vectors(table: PoseTable, scan: SelectedScan) -> Geometry:
    """The projections of a table of vectors, in the rows and with the binning of the selection."""
    from recon.base.vectors import geometry_of_vectors

    assert table.vectors is not None
    source, selection = scan.source, scan.selection
    if selection.axis_col is not None:
        raise ConfigError(f"Omit --axis: the vectors of {table.path} already determine the axis.")
    try:
        views = geometry_of_vectors(table.vectors, source.shape, cone=table.cone)
    except ValueError as error:
        raise DataError(f"{table.path}: {error}. Nothing was read.") from error
    if table.cone != (selection.cone is not None):
        advice = f"give --cone {views.sod:.6g}:{views.sdd:.6g}" if table.cone else "give vectors with src_x to v_z"
        beam = "a cone" if table.cone else "a parallel beam"
        raise ConfigError(f"{table.path} has vectors of {beam}, but {source.path} has another beam: {advice}.")
    size = selection.pixel_size_mm
    if size is None or abs(size - views.pixel_pitch) > _SAME_SIZE * size:
        has_other_pixels = "does not state its pixel size" if size is None else f"has pixels of {1e3 * size:.6g} um"
        pitch_um = 1e3 * views.pixel_pitch
        raise ConfigError(
            f"{table.path} has vectors for pixels of {pitch_um:.6g} um, but {source.path} {has_other_pixels}; expected "
            "the same size. Give --pixel-size-um, or vectors in mm."
        )
    rows = selection.detector_rows
    return views.rows(rows.start, rows.stop).binned(selection.binning)


def _pixels_per_unit(table: PoseTable, scan: SelectedScan) -> float:
    """Size of a pixel of the unbinned detector in the unit of the table."""
    if table.unit == "px":
        return 1.0
    if scan.selection.cone is not None:
        raise DataError(
            f"Give a CSV of shifts in pixels instead of {table.path}: in a cone beam, translations of the "
            "sample in mm are not shifts of the projections, because the magnification differs along the "
            "beam. Nothing was read."
        )
    size = scan.selection.pixel_size_mm
    if size is None:
        raise DataError(
            f"Give --pixel-size-um: {table.path} is in mm, but {scan.source.path} does not state its pixel size."
        )
    return 1 / size


def _rows_of_frames(table: PoseTable, source: ScanSource, frames: I64) -> I64:
    """[frame of the scan] row of the frame in the table; -1: the table has no such row. If the scan and the table both
    state an angle, the angles must agree.
    """
    n, views = len(source.table), source.table.views
    if table.frames is not None and table.frames != n:
        raise DataError(
            f"{table.path} has {table.frames} frames, but {source.path} has {n}; expected a file of the same scan."
        )
    row_of_frame, degrees = np.full(n, -1, np.int64), np.degrees(source.table.angles)
    distances = np.diff(np.unique(np.round(degrees[frames], 9)))
    tolerance = _ANGLE_TOLERANCE * (float(np.median(distances)) if distances.size else 1.0)
    if table.by == "angle_deg":
        order = np.argsort(table.keys)
        sorted_degrees = table.keys[order]
        right = np.clip(np.searchsorted(sorted_degrees, degrees[views]), 0, sorted_degrees.size - 1)
        left = np.maximum(right - 1, 0)
        angles = degrees[views]
        nearest = np.where(np.abs(sorted_degrees[left] - angles) < np.abs(sorted_degrees[right] - angles), left, right)
        agrees = np.abs(sorted_degrees[nearest] - angles) <= tolerance
        row_of_frame[views[agrees]] = order[nearest[agrees]]
    else:
        frame_of_key = views if table.by == "view" else np.arange(n)
        if (is_beyond_end := table.keys >= frame_of_key.size).any():
            number = table.keys[is_beyond_end][0]
            raise DataError(
                f"{table.path} states {table.by} {number:g}, but {source.path} has {frame_of_key.size} {table.by}s, "
                "counted from 0."
            )
        row_of_frame[frame_of_key[table.keys.astype(np.int64)]] = np.arange(table.keys.size)
        if table.angles_deg is not None:
            stated_twice = frames[row_of_frame[frames] >= 0]
            differences = np.abs(table.angles_deg[row_of_frame[stated_twice]] - degrees[stated_twice])
            if (differences > tolerance).any():
                frame = int(stated_twice[differences > tolerance][0])
                stated = table.angles_deg[row_of_frame[frame]]
                scan_degrees = degrees[frame]
                raise DataError(
                    f"{table.path} states the angle {stated:.6g} degrees for frame {frame}, but {source.path} states "
                    f"{scan_degrees:.6g} degrees; expected the poses of the same scan."
                )
    return row_of_frame


def require_stated(poses: ScanPoses, source: ScanSource, view_ids: I64) -> None:
    """Raise DataError if projections have no pose."""
    without_pose, table = view_ids[~poses.stated(view_ids)], poses.table
    if without_pose.size:
        degrees = np.degrees(source.table.angles[without_pose[0]])
        first_without_pose = without_pose[0]
        raise DataError(
            f"{table.path} has no pose for {without_pose.size} of the {view_ids.size} projections chosen from "
            f"{source.path} (the first: frame {first_without_pose}, at {degrees:.6g} degrees). Add the missing poses, "
            "or use --views to choose only projections that have a pose."
        )


def _sentence(table: PoseTable, shifts: F64) -> str:
    if table.vectors is not None:
        return f"The geometry of {count(table.keys.size, 'projection')} comes from the ASTRA vectors in {table.path}."
    column_range, row_range = np.ptp(shifts, axis=0)
    roll, tilt = np.abs(table.turns_deg).max(axis=0)
    return (
        f"{count(table.keys.size, 'pose')} from {table.path}: shifts over {column_range:.3g} px (columns) and "
        f"{row_range:.3g} px (rows), roll up to {roll:.3g}° and tilt up to {tilt:.3g}°."
    )
