"""Rotation axis of a scan: stated by the user, found from the projections, or stated by the file."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.sinks import Warn
from beamline.projections.correction import ScanCorrectionPlan, apply, line_integrals_of, survey
from beamline.projections.corrections.poses import ScanPoses
from beamline.projections.selection import SelectedScan, check_axis, unbinned
from beamline.projections.usable_views import UsableViews, longest_part
from beamline.storage.readers.base import ScanSource
from recon.axis_held_out import COLS, VIEWS, axis_by_views
from recon.base.geometry import Geometry
from recon.base.masks import areas
from recon.base.views import spread, spread_views
from recon.prep.align import AxisError, AxisEstimate, find_axis
from recon.prep.axis_ends import ENDS
from recon.prep.axis_wedge import AGREE
from recon.prep.projections import Projections

_AXIS_VIEWS = 360  # most projections that are used: more do not make the axis more accurate, and take time to read
_AXIS_ROWS = 64
# fewest projections with which a given axis is checked. With fewer, the result may look certain and be wrong.
_COMPARED, _FEWEST = 90, 20
# columns of binned projections: an axis is confirmed if held-out projections find it within this distance
_CONFIRMED = 0.5
_CANDIDATES = 14  # usual number of candidates for the axis of a cone beam
# largest share of the total absorption in replaced pixels; it shifts the centre of mass by at most 1 % of half the
# width
_GUESSED = 0.01


@dataclass(frozen=True)
class LocatedAxis:
    """The rotation axis found in a band of rows.

    Attributes:
        col: column of the axis on the full detector.
        warning: what to check if there is no clear optimum; empty if there is one.
    """

    col: float
    estimate: AxisEstimate
    warning: str = ""


def rotation_axis(
    plan: ScanCorrectionPlan,
    usable: UsableViews,
    poses: ScanPoses | None,
    warn: Warn,
    progress: Callable[[int, int], None],
) -> tuple[float, AxisEstimate | None]:
    """The rotation axis in columns of the full detector, and how it was found (None if the user gave it).

    With `poses`, opposite projections are not mirror images.

    Raises:
        DataError: no axis explains the projections.
        ConfigError: the axis lies outside the detector.
    """
    if poses is not None and poses.vectors is not None:
        return poses.axis_col, None
    scan, selection, axis = plan.scan, plan.scan.selection, None
    axis_col = selection.axis_col
    straight = poses is None and selection.cone is None
    if axis_col is None and not straight:
        axis_col, axis = _axis_by_views(scan, usable.frames, poses, warn, progress)
    elif axis_col is None:
        located = _axis_between_jumps(plan, usable, warn, progress)
        axis_col, axis = located.col, located.estimate
        if located.warning:
            warn(located.warning)
    check_axis(scan.source, axis_col)
    if selection.axis_col is not None and straight and usable.frames.size >= _FEWEST:
        _compare_with_views(axis_col, plan, usable.frames, warn)
    return axis_col, axis


def _compare_with_views(stated_col: float, plan: ScanCorrectionPlan, frames: NDArray[np.int64], warn: Warn) -> None:
    """Warn if some projections clearly show another axis than the axis that the user gave."""
    with suppress(DataError):
        compared_frames = spread(frames, _COMPARED)
        located = locate_axis(plan, compared_frames, complete=False)
        if located.estimate.confident and abs(located.col - stated_col) > AGREE * plan.scan.selection.binning:
            warn(
                f"Check --axis: the projections show the rotation axis at column {located.col:.2f}, but "
                f"{stated_col:g} was given. Columns are counted from 0 at the centre of the first column. "
                "Unless the sample moved, omit --axis, or compare columns with `beamline sweep FILE "
                "axis=A:B:STEP`."
            )


def _axis_by_views(
    scan: SelectedScan,
    frames: NDArray[np.int64],
    poses: ScanPoses | None,
    warn: Warn,
    progress: Callable[[int, int], None],
) -> tuple[float, AxisEstimate | None]:
    """The axis found with held-out projections. The axis of the file is kept unless the held-out projections show
    another axis clearly.
    """
    source, stated, cols = scan.source, scan.source.axis_col, scan.source.shape[1]
    if scan.selection.axis_rows is not None:
        scan = scan.part(rows=scan.selection.axis_rows)
    selection = scan.selection
    rows = selection.detector_rows
    # With few rows, columns would not be binned and volumes would take minutes, so more rows around them are read.
    height = max(rows.stop - rows.start, min(cols // COLS, source.shape[0]))
    first = min(max((rows.start + rows.stop - height) // 2, 0), source.shape[0] - height)
    binning = max(selection.binning, min(cols // COLS, height))
    coarse = scan.part(binning=binning, rows=(first, first + height))
    if poses is not None:
        poses, frames = replace(poses, pivot=coarse.selection.pivot, binning=binning), frames[poses.stated(frames)]
    views = line_integrals_of(coarse, spread(frames, VIEWS))
    first_guess = (cols - 1) / 2 if stated is None else stated
    geometry = coarse.selection.geometry(first_guess, source.table.angles[views.view_ids])
    if poses is not None:
        geometry = poses.corrected(geometry, views.view_ids)
    try:
        estimate = axis_by_views(views.data, geometry, lambda n: progress(n, max(n, _CANDIDATES)), lit=views.lit)
    except ValueError as error:
        if stated is None:
            raise _not_found(source, error) from error
        if isinstance(error, AxisError):
            warn(f"The rotation axis in the file, column {stated:.2f}, could not be confirmed: {error}.")
        return stated, None
    axis_col = unbinned(estimate.value, binning)
    if stated is None:
        if not estimate.confident:
            warn(_unclear(axis_col))
        return axis_col, estimate
    if not estimate.confident:
        warn(
            "Check the slices for double edges, or give --axis COLUMN: the rotation axis in the file, "
            f"column {stated:.2f}, could not be confirmed, because the held-out projections do not show "
            "an axis clearly."
        )
    if not estimate.confident or abs(axis_col - stated) <= _CONFIRMED * binning:
        return stated, None
    warn(
        f"The rotation axis at column {axis_col:.2f} is used, because held-out projections agree better with this "
        f"column than with the file's column {stated:.2f}. To use the column in the file, give --axis {stated:g}."
    )
    return axis_col, estimate


def _axis_between_jumps(
    plan: ScanCorrectionPlan,
    usable: UsableViews,
    warn: Warn | None,
    progress: Callable[[int, int], None],
) -> LocatedAxis:
    """The rotation axis from the longest part between jumps of the sample, if that part shows it clearly, otherwise
    from all projections.
    """
    if (rows := plan.scan.selection.axis_rows) is not None:
        plan, warn = survey(plan.scan.part(rows=rows), usable.frames), None
    part = longest_part(usable.frames, usable.jumps)
    if part.size < usable.frames.size:
        with suppress(DataError):
            located = locate_axis(plan, part, warn, progress)
            if located.estimate.confident:
                return located
    return locate_axis(plan, usable.frames, warn, progress)


def locate_axis(
    plan: ScanCorrectionPlan,
    frames: NDArray[np.int64],
    warn: Warn | None = None,
    progress: Callable[[int, int], None] = lambda n, total: None,
    *,
    complete: bool = True,
) -> LocatedAxis:
    """Find the rotation axis from a band of rows of projections spread over `frames`; `warn` as in `apply`.

    If the estimate has no clear optimum, the axis stated in the file is used. If the file states none and the
    projections are `complete`, held-out projections find the axis. Held-out projections would mislead if only a part
    of the rotation was measured, or only 180 degrees of a sample wider than the field of view.

    Raises:
        DataError: no axis in the search range explains the projections.
    """
    height, binning = plan.scan.selection.n_rows, plan.scan.selection.binning
    start, source = max(0, (height - _AXIS_ROWS) // 2), plan.source
    frames = spread_views(source.table.angles[frames], _AXIS_VIEWS, frames)
    band = apply(plan, frames, slice(start, min(height, start + _AXIS_ROWS)), warn, progress)
    # columns behind slits that were replaced; their noise would strongly affect the axis
    masked_cols = band.masked.all(axis=0)
    exposed_cols = np.flatnonzero(~masked_cols | masked_cols.all())
    angles = source.table.angles[band.view_ids]
    try:
        estimate = find_axis(np.ascontiguousarray(band.data[..., exposed_cols[0] : exposed_cols[-1] + 1]), angles)
        estimate = replace(
            estimate, value=estimate.value + exposed_cols[0], candidates=estimate.candidates + exposed_cols[0]
        )
        if exposed_cols.size < band.data.shape[2] and not estimate.confident:
            estimate = find_axis(band.data, angles)
    except ValueError as error:
        raise _not_found(source, error) from error
    uncertain = not estimate.confident and source.axis_col is None and estimate.method != ENDS
    if complete and (uncertain or _material_was_guessed(band)):
        estimate = _by_held_out_views(band, angles) or estimate
    axis_col = unbinned(estimate.value, binning)
    if estimate.confident:
        return LocatedAxis(axis_col, estimate)
    if source.axis_col is None:
        return LocatedAxis(axis_col, estimate, _unclear(axis_col))
    return LocatedAxis(
        source.axis_col,
        estimate,
        f"Check the slices, or give --axis COLUMN: the rotation axis found, column {axis_col:.2f}, is not "
        f"a clear optimum, so the file's column {source.axis_col:.2f} is used.",
    )


def _material_was_guessed(band: Projections) -> bool:
    """True if parts of rows without data were filled with sample material. The position of this material is a guess."""
    if not band.unmeasured.size or (exposed := band.lit) is None:
        return False
    return bool(band.data[~exposed & exposed.any(axis=2, keepdims=True)].sum() > _GUESSED * band.data.sum())


def _by_held_out_views(band: Projections, angles: NDArray[np.float64]) -> AxisEstimate | None:
    """The axis if the sample is wider than the field of view, or if a part of the detector has no beam. None: the axis
    was not found.

    If a part of the detector has no beam, the axis is uncertain by half a column, and by more if the sample also
    extends beyond the field of view.
    """
    if band.data.shape[1] < band.data.shape[2] // COLS:
        return None  # otherwise columns would not be binned, and volumes would take minutes
    without_beam, view_numbers, exposed = areas(band.masked), spread(np.arange(angles.size), VIEWS), band.lit
    data = np.ascontiguousarray(band.data[view_numbers])
    with suppress(ValueError):
        estimate = axis_by_views(
            data, Geometry.parallel(angles[view_numbers], data.shape[1:]),
            lit=None if exposed is None else exposed[view_numbers],
        )  # fmt: skip
        if estimate.confident or without_beam.any():
            return replace(estimate, confident=not without_beam.any())
    return None


def stated_axis(source: ScanSource) -> float:
    """The rotation axis stated by the file of a cone-beam scan that is still running.

    Raises:
        DataError: the file does not state the axis.
    """
    if source.axis_col is None:
        raise DataError(
            f"Give the rotation axis with --axis COLUMN (0 is the centre of the first column): {source.path} does "
            "not state the axis, and the axis of a cone beam cannot be searched during the scan."
        )
    return source.axis_col


def _not_found(source: ScanSource, error: Exception) -> DataError:
    return DataError(
        f"{source.path}: no rotation axis was found: {error}. Give the column of the axis with --axis COLUMN (0 is "
        "the centre of the first column)."
    )


def _unclear(axis_col: float) -> str:
    return (
        f"Check the slices for double edges, because the rotation axis found, column {axis_col:.2f}, is not a clear "
        "optimum. `beamline sweep FILE axis=A:B:STEP` compares columns, and --axis COLUMN sets the column."
    )
