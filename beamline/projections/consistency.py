"""Consistency: warns where no sample at rest could give the views at the angles, heights and axis that are stated."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from beamline.core.sinks import Warn
from beamline.core.text import count, spans
from beamline.projections.corrections.air import Air
from beamline.projections.corrections.references import ReferenceCheck
from beamline.projections.prepared import PreparedProjections
from beamline.projections.refusals import refuse
from beamline.projections.selection import Selection, unbinned
from beamline.projections.truncation import cut_sides
from beamline.storage.readers.base import ScanSource
from beamline.storage.rules.light import light_beside_flats
from beamline.storage.rules.references import groups_taken, reference_groups
from recon.base.arrays import F32, median_deviation
from recon.prep.correct import Projections
from recon.prep.moments import ViewMoments, moments_of
from recon.voxels.view_weights import covers_the_circle

_VIEWS = 180  # more do not sharpen the moments, they only cost reading
_COLUMN_VIEWS = 32  # whose columns are looked at
_LEAST_VIEWS, _LEAST_ROWS = 12, 8  # with fewer rows nobody knows how much they disagree
_HALF_A_PIXEL = 0.5  # doubles edges as far as the resolution, as for the monitor's `opposite`
_MOST_OF_THEM = 5, 95  # percent of views: one that a crumb crosses does not count
_NOISE = 3.3  # standard deviations between these percentiles, of noise alone
_ACROSS = 1.0  # columns: a teapot that hardens by 12 % has 0.7, a measured tooth 0.5
_MASS, _OUTLIERS = 0.03, 6.0  # share, as for the monitor's `mass`, and in standard deviations of most views
_AXES_AGREE = 0.75  # columns, as for a pair of opposite views
_STRETCH = 0.015  # a thorax hardened by 12 % has 0.011, measured scans up to 0.009, 60 other scans at rest less
_NEAR = 1.0  # columns between the centres' axis and the one used, beyond which angles are not judged
_FAINT = 0.3  # line integral
_AIR = 0.1  # of the deepest line integral: as much as an edge may have where the sample is in the field
_SURE = 4.0  # standard deviations


def warn_of_inconsistency(prepared: PreparedProjections, selection: Selection, warn: Warn) -> None:
    """Warn of angles, heights, turned frames and of an axis that moments of the views disagree with.

    The moments hold for a parallel beam and a sample within the field; other scans are passed over. So is a part of the
    rows: those of Diamond 24737 above its metal seem to turn by 14 % more, for a reason that is not known.
    """
    geometry, data = prepared.geometry, prepared.projections.data
    wide = geometry.is_off_middle and covers_the_circle(geometry.angles)
    whole = geometry.rows_show_slices and not geometry.shifts.any() and not wide
    few = len(data) < _LEAST_VIEWS or data.shape[1] < _LEAST_ROWS or selection.rows is not None
    if not whole or few or prepared.measured is not None or prepared.emission is not None:
        return
    some = _evenly(len(data), _VIEWS)
    if cut_sides(data, geometry) or _air_is_off(data, some):
        return
    shown = moments_of((data[view] for view in some), geometry.angles[some], geometry.axis_col)
    if shown.flipped.any():
        frames = prepared.projections.view_ids[some[shown.flipped]]
        warn(
            f"{count(frames.size, 'view')} of {some.size} looked at (frames {spans(frames.tolist())}) hold the matter "
            "of the first view's rows in the opposite order, the last row first: were they turned upside down? Turn "
            "them in a copy of the scan, or leave them out with --views."
        )
    if other := _masses(shown, prepared.projections.view_ids[some]):
        warn(other)
        return  # such views spoil the other moments
    sentences = (
        _across(shown),
        _heights(shown),
        _angles(shown, geometry.angles) if abs(shown.axis_col - geometry.axis_col) <= _NEAR else "",
        _axis(shown, geometry.axis_col, selection),
    )
    for sentence in filter(None, sentences):
        warn(sentence)


def compare_with_flats(
    source: ScanSource, selection: Selection, projections: Projections, warn: Warn, *, refused: bool = True
) -> None:
    """Warn of views that are not of the light of their flats.

    Args:
        refused: a difference that no beam has is an error.

    Raises:
        DataError: such a difference, and the references are checked.
    """
    if source.quantity != "counts" or not len(projections.data):
        return
    accepted = selection.step(ReferenceCheck).accepted
    said = selection.step(Air).model != "auto"  # columns that are said to be air
    groups = groups_taken(source) if accepted else reference_groups(source).good()
    if not (groups.darks and groups.flats):
        return
    if any(projections.air_columns):
        level = -float(np.log(np.median(projections.air)))
    else:
        columns = [np.median(projections.data[view], axis=0) for view in _evenly(len(projections.data), _COLUMN_VIEWS)]
        level = float(np.median(columns, axis=0).min())
    air = any(projections.air_columns)
    for finding in light_beside_flats(source, groups, level, air, accepted or said or not refused):
        refuse(source, [finding])
        warn(finding.message)


def _evenly(n: int, most: int) -> NDArray[np.intp]:
    return np.unique(np.linspace(0, n - 1, min(n, most)).astype(int))


def _air_is_off(data: F32, some: NDArray[np.intp]) -> bool:
    """Matter is faint beside errors of the air, or the edges are far from 0, as where the light drifts without --air:
    air has moments, too."""
    edges = np.abs([np.median(data[view][:, [0, -1]]) for view in some])
    deepest = float(np.median([data[view].max() for view in some]))
    return deepest < _FAINT or float(np.percentile(edges, _MOST_OF_THEM[1])) > _AIR * deepest


def _masses(shown: ViewMoments, frames: NDArray[np.int64]) -> str:
    odd = np.abs(shown.mass) > max(_MASS, _OUTLIERS * median_deviation(shown.mass))
    if not odd.any():
        return ""
    most = shown.mass[odd][np.abs(shown.mass[odd]).argmax()]
    return (
        f"{count(int(odd.sum()), 'view')} of {odd.size} looked at (frames {spans(frames[odd].tolist())}) hold "
        f"{most:+.1%} matter beside the others, at most, where a sample within the field has one mass in all views: "
        "something else stood in the beam, or the light is wrong. Look at them; --views leaves them out."
    )


def _across(shown: ViewMoments) -> str:
    if not np.isfinite(shown.across).all():
        return ""
    left, right = np.percentile(shown.across, _MOST_OF_THEM)
    if right - left < max(_ACROSS, 2 * _NOISE * shown.across_sigma):
        return ""
    return (
        f"The centre of mass leaves its way about the axis by {right - left:.1f} columns, from one view to another "
        f"(uncertain by {shown.across_sigma:.2g}): the sample or the stage moved across, or frames are not those of "
        "their angles. Give --calibrate shifts, or --poses; --time where the sample changes."
    )


def _heights(shown: ViewMoments) -> str:
    if not np.isfinite([*shown.down, shown.down_sigma]).all() or shown.flipped.any():
        return ""
    low, high = np.percentile(shown.down, _MOST_OF_THEM)
    if high - low < max(_HALF_A_PIXEL, 2 * _NOISE * shown.down_sigma):
        return ""
    return (
        f"From view to view the matter stands up to {high - low:.1f} rows higher or lower (from {shown.down[0]:+.1f} "
        f"rows in the first view to {shown.down[-1]:+.1f} in the last; uncertain by {shown.down_sigma:.2g}), where "
        "each row of a sample at rest holds one mass in all views: slices are blurred across rows. Give --calibrate "
        "shifts where the sample or the stage moved, or --poses; --time where the sample changes."
    )


def _angles(shown: ViewMoments, angles: NDArray[np.floating]) -> str:
    if not abs(shown.stretch) > max(_STRETCH, _SURE * shown.stretch_sigma):
        return ""
    span = float(np.degrees(np.ptp(angles)))
    return (
        f"The views seem to turn by {span * (1 + shown.stretch):.4g} degrees, and are stated to turn by {span:.4g} "
        f"({shown.stretch:+.1%} ± {shown.stretch_sigma:.1%}, by the moments of their rows). Are the angles those of "
        "another scale or range, are views missing within the scan, or did the sample move? Give the right angles with "
        "--angles FILE (degrees, one a line), or compare slices made with them."
    )


def _axis(shown: ViewMoments, used: float, selection: Selection) -> str:
    if selection.axis_col is None or not abs(shown.axis_col - used) > max(_AXES_AGREE, _SURE * shown.axis_sigma):
        return ""
    seen = unbinned(shown.axis_col, selection.binning)
    return (
        f"The centres of mass of the views go round column {seen:.2f}; the rotation axis given is column "
        f"{selection.axis_col:g}. Columns are counted from 0 at the centre of the first. Unless the sample moved, "
        "leave --axis out, or compare axes by `beamline sweep FILE axis=A:B:STEP`."
    )
