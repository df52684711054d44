"""The rotation axis of a scan: given, found by its views, or stated by the file."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.sinks import Warn
from beamline.projections.correction import ScanCorrection, line_integrals_of
from beamline.projections.corrections.poses import ScanPoses
from beamline.projections.selection import ScanSelection, check_axis, unbinned
from beamline.projections.usable_views import UsableViews, longest_part
from beamline.storage.readers.base import ScanSource
from beamline.storage.rules.evidence import ScanEvidence
from recon.axis_held_out import COLS, VIEWS, axis_by_views
from recon.base.geometry import Geometry
from recon.base.masks import areas
from recon.base.views import spread, spread_views
from recon.prep.align import AxisError, AxisEstimate, find_axis
from recon.prep.axis_ends import ENDS
from recon.prep.axis_wedge import AGREE
from recon.prep.projections import Projections

_AXIS_VIEWS = 360  # more views do not sharpen the axis, they only cost reading
_AXIS_ROWS = 64
_COMPARED, _FEWEST = 90, 20  # views that are enough for an axis that is given; fewer may be sure and wrong
_CONFIRMED = 0.5  # columns, of binned views, up to which those held out confirm an axis
_CANDIDATES = 14  # of the axis of a cone, usually
_GUESSED = 0.01  # of the mass in filled pixels moves the centre of mass by at most a hundredth of half the width


def rotation_axis(
    scan: ScanEvidence,
    selection: ScanSelection,
    correction: ScanCorrection,
    usable: UsableViews,
    poses: ScanPoses | None,
    warn: Warn,
    progress: Callable[[int, int], None],
) -> tuple[float, AxisEstimate | None]:
    """The rotation axis in columns of the full detector, and how it was found (None if the user gave it).

    With `poses`, opposite views are no mirror images.

    Raises:
        DataError: no axis explains the views.
        ConfigError: it lies outside the detector.
    """
    if poses is not None and poses.vectors is not None:
        return poses.axis_col, None
    source, axis = scan.source, None
    axis_col = selection.axis_col
    straight = poses is None and selection.cone is None
    if axis_col is None and not straight:
        axis_col, axis = _axis_by_views(scan, selection, usable.frames, poses, warn, progress)
    elif axis_col is None:
        by = correction
        if selection.axis_rows is not None:
            by = ScanCorrection(scan, replace(selection, rows=selection.axis_rows), lambda _: None, usable.frames)
        axis_col, axis = _axis_beside_jumps(by, usable, warn, progress)
    check_axis(source, axis_col)
    if selection.axis_col is not None and straight and usable.frames.size >= _FEWEST:
        _compare_with_views(axis_col, correction, usable.frames, warn)
    return axis_col, axis


def _compare_with_views(given: float, correction: ScanCorrection, frames: NDArray[np.int64], warn: Warn) -> None:
    """Warn where some of the views clearly show another column than the one that was given."""
    with suppress(DataError):
        some = spread(frames, _COMPARED)
        shown, estimate = locate_axis(correction.quiet(), some, lambda _: None, all_there=False)
        if estimate.confident and abs(shown - given) > AGREE * correction.binning:
            warn(
                f"The views show the rotation axis in column {shown:.2f}; column {given:g} was given. Columns are "
                "counted from 0 at the centre of the first. Unless the sample moved, leave --axis out, or compare axes "
                "by `beamline sweep FILE axis=A:B:STEP`."
            )


def _axis_by_views(
    scan: ScanEvidence,
    selection: ScanSelection,
    frames: NDArray[np.int64],
    poses: ScanPoses | None,
    warn: Warn,
    progress: Callable[[int, int], None],
) -> tuple[float, AxisEstimate | None]:
    """The axis by views held out. What the file states stays, unless they agree better with another one."""
    source, stated, cols = scan.source, scan.source.axis_col, scan.source.shape[1]
    if selection.axis_rows is not None:
        selection = replace(selection, rows=selection.axis_rows)
    rows = selection.detector_rows
    # Few rows would leave columns fine, for which volumes take minutes: rows beside them are read, too.
    height = max(rows.stop - rows.start, min(cols // COLS, source.shape[0]))
    first = min(max((rows.start + rows.stop - height) // 2, 0), source.shape[0] - height)
    binning = max(selection.binning, min(cols // COLS, height))
    coarse = replace(selection, binning=binning, rows=(first, first + height))
    if poses is not None:
        poses, frames = replace(poses, pivot=coarse.pivot, binning=binning), frames[poses.stated(frames)]
    views = line_integrals_of(scan, coarse, spread(frames, VIEWS))
    begin = (cols - 1) / 2 if stated is None else stated
    geometry = coarse.geometry(begin, source.table.angles[views.view_ids])
    if poses is not None:
        geometry = poses.corrected(geometry, views.view_ids)
    try:
        estimate = axis_by_views(views.data, geometry, lambda n: progress(n, max(n, _CANDIDATES)), lit=views.lit)
    except ValueError as error:
        if stated is None:
            raise _not_found(source, error) from error
        if isinstance(error, AxisError):
            warn(f"The file's rotation axis, column {stated:.2f}, was not confirmed: {error}.")
        return stated, None
    axis_col = unbinned(estimate.value, binning)
    if stated is None:
        if not estimate.confident:
            warn(_unclear(axis_col))
        return axis_col, estimate
    if not estimate.confident:
        warn(
            f"The file's rotation axis, column {stated:.2f}, was not confirmed: views held out show no axis clearly. "
            "Check the slices for doubled edges, or give --axis COLUMN."
        )
    if not estimate.confident or abs(axis_col - stated) <= _CONFIRMED * binning:
        return stated, None
    warn(
        f"Views held out agree better with a rotation axis in column {axis_col:.2f} than with the file's {stated:.2f}: "
        f"the former is used. --axis {stated:g} keeps the file's."
    )
    return axis_col, estimate


def _axis_beside_jumps(
    correction: ScanCorrection,
    usable: UsableViews,
    warn: Warn,
    progress: Callable[[int, int], None],
) -> tuple[float, AxisEstimate]:
    """The rotation axis by the longest part between jumps, where that shows it clearly, else by all views."""
    part = longest_part(usable.frames, usable.jumps)
    if part.size < usable.frames.size:
        with suppress(DataError):
            located = locate_axis(correction, part, lambda _: None, progress)
            if located[1].confident:
                return located
    return locate_axis(correction, usable.frames, warn, progress)


def locate_axis(
    correction: ScanCorrection,
    frames: NDArray[np.int64],
    warn: Warn,
    progress: Callable[[int, int], None] = lambda n, total: None,
    *,
    all_there: bool = True,
) -> tuple[float, AxisEstimate]:
    """Find the rotation axis, in columns of the full detector, from a band of rows of views spread over `frames`.

    An estimate without a clear optimum gives way to what the file states. If it states nothing and the views are
    `all_there`, the estimate gives way to views held out; those of a part of the turn would mislead, and those of half
    a turn of a sample wider than the field.

    Raises:
        DataError: no axis in the search range explains the views.
    """
    height = (correction.rows.stop - correction.rows.start) // correction.binning
    start, source = max(0, (height - _AXIS_ROWS) // 2), correction.source
    frames = spread_views(source.table.angles[frames], _AXIS_VIEWS, frames)
    band = correction.at_once(frames, slice(start, min(height, start + _AXIS_ROWS)), progress)
    hidden = band.masked.all(axis=0)  # columns behind slits, which were filled: their noise has a long lever
    lit = np.flatnonzero(~hidden | hidden.all())
    angles = source.table.angles[band.view_ids]
    try:
        estimate = find_axis(np.ascontiguousarray(band.data[..., lit[0] : lit[-1] + 1]), angles)
        estimate = replace(estimate, value=estimate.value + lit[0], candidates=estimate.candidates + lit[0])
        if lit.size < band.data.shape[2] and not estimate.confident:
            estimate = find_axis(band.data, angles)
    except ValueError as error:
        raise _not_found(source, error) from error
    unsure = not estimate.confident and source.axis_col is None and estimate.method != ENDS
    if all_there and (unsure or _hides_matter(band)):
        estimate = _by_unseen_views(band, angles) or estimate
    axis_col = unbinned(estimate.value, correction.binning)
    if estimate.confident:
        return axis_col, estimate
    if source.axis_col is None:
        warn(_unclear(axis_col))
        return axis_col, estimate
    warn(
        f"The rotation axis found, column {axis_col:.2f}, is not a clear optimum: the file's {source.axis_col:.2f} is "
        "used. Check the slices, or give --axis COLUMN."
    )
    return source.axis_col, estimate


def _hides_matter(band: Projections) -> bool:
    """Whether parts of rows that measured nothing in a view were filled with matter, whose place is a guess."""
    if not band.unmeasured.size or (lit := band.lit) is None:
        return False
    return bool(band.data[~lit & lit.any(axis=2, keepdims=True)].sum() > _GUESSED * band.data.sum())


def _by_unseen_views(band: Projections, angles: NDArray[np.float64]) -> AxisEstimate | None:
    """The axis of a sample wider than the field, or of a detector in part without beam; None: not found so either.

    A part without beam leaves it unsure: half a column, and more where the sample leaves the field, too.
    """
    if band.data.shape[1] < band.data.shape[2] // COLS:
        return None  # columns would stay fine, and volumes take minutes
    dark, some, lit = areas(band.masked), spread(np.arange(angles.size), VIEWS), band.lit
    data = np.ascontiguousarray(band.data[some])
    with suppress(ValueError):
        estimate = axis_by_views(
            data, Geometry.parallel(angles[some], data.shape[1:]), lit=None if lit is None else lit[some]
        )  # fmt: skip
        if estimate.confident or dark.any():
            return replace(estimate, confident=not dark.any())
    return None


def stated_axis(source: ScanSource) -> float:
    """The rotation axis stated by the file of a cone-beam scan, for a scan that is still running.

    Raises:
        DataError: it states none.
    """
    if source.axis_col is None:
        raise DataError(
            f"{source.path} does not say where the rotation axis is, and that of a cone beam is not searched while "
            "views come. Give it with --axis COLUMN (0 is the centre of the first column)."
        )
    return source.axis_col


def _not_found(source: ScanSource, error: Exception) -> DataError:
    return DataError(
        f"{source.path}: the rotation axis was not found: {error}. Give it with --axis COLUMN (0 is the centre of "
        "the first column)."
    )


def _unclear(axis_col: float) -> str:
    return (
        f"The rotation axis found, column {axis_col:.2f}, is not a clear optimum. Check the slices for doubled edges "
        "(`beamline sweep FILE axis=A:B:STEP` compares columns), or give --axis COLUMN."
    )
