"""Consistency: checks conditions that all projections of a sample at rest must meet, and whether the intensity of the
projections matches the flats.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from beamline.core.sinks import Warn
from beamline.core.text import count, frames_text
from beamline.projections.corrections.air import Air
from beamline.projections.prepared import PreparedProjections
from beamline.projections.selection import ScanSelection, SelectedScan
from beamline.projections.tilt import MATTERS, tilt_text
from beamline.projections.views import refuse
from beamline.storage.rules.light import WARN, check_air_level
from recon.base.arrays import F32, F64, median_deviation
from recon.base.geometry import Geometry
from recon.base.noise import NOISE_VIEWS, noise_level
from recon.base.views import spread
from recon.prep.fan import fans_shown
from recon.prep.moments import ViewMoments, moments_of
from recon.prep.projections import Projections
from recon.prep.repeats import changes_seen
from recon.prep.tilt import roll_of_mean_view
from recon.voxels.beyond_field import reach_of
from recon.voxels.view_weights import circle_weights, covers_the_circle

_VIEWS = 180  # projections used for the moments: more do not make the moments more accurate, and take time to read
_COLUMN_VIEWS = 32  # projections whose columns are examined
_LEAST_VIEWS, _LEAST_ROWS = 12, 8  # with fewer rows, the disagreement between rows cannot be estimated
_HALF_A_PIXEL = 0.5  # a larger shift doubles edges visibly; the same limit as of the monitor's check `opposite`
# percentiles over the projections, so that a single projection with a particle in front of the sample does not count
_PERCENTILES = 5, 95
_NOISE = 3.3  # distance of these percentiles, in standard deviations, if there is only noise
_LEAST_COL_SHIFT = 1.0  # columns: a teapot with 12 % beam hardening has 0.7, a measured tooth 0.5
_INTENSITY_STEP = 0.1  # line integral; the same limit as of the monitor's alarm `gain`
_OF_LOCAL = 3.0  # factor on the change to the next projection, because opposite angles may differ by up to one step
# radians: with steps this small, even a slab 20 times as long as thick and wider than the field of view has no single
# outlier
_BESIDE = np.radians(4.1)
# share of the total absorption (as for the monitor's check `mass`); standard deviations of most projections
_ABSORPTION_OUTLIER, _OUTLIERS = 0.03, 6.0
# share between these percentiles over the projections: Diamond 24737 has 0.011, a tooth 0.019
_ABSORPTION_RANGE, _TENTHS = 0.06, (10, 90)
_FEW = 0.2  # up to this share of the projections, outliers are named one by one, however large they are
# relative error of the angular range. A thorax with 12 % hardening has 0.011, measured scans up to 0.009, 60 other
# scans at rest less
_ANGLE_SCALE_TOLERANCE = 0.015
# In steps: how close the measured range must be to the other way of counting the ends of a 180° or 360° scan (with or
# without both ends, a step apart). Found in 31 of 40 scans with this error, and in none of 232 without it.
_OF_A_STEP = 1 / 3
_BESIDE_ROW = 8  # number of rows above and below the plane of the source that count as lying in the plane
# factor on the least disagreement; least disagreement as a share of the variance; degrees
_OFTEN, _AGREE, _FAN = 1.3, 0.01, 2.5
# the same for the fan that is right if SDD was stated from the axis; radians from that fan
_OFTEN_BY_AXIS, _SAME_FAN = 1.15, 0.01
# columns between the axis found from the moments and the axis used; beyond that, angles are not checked
_SAME_AXIS = 1.0
_FAINT = 0.3  # line integral: in fainter samples, an error of the air at an edge is a large part
# share of pixels below the smallest transmission; their line integrals are too small, which another warning reports
_FLOORED = 1e-3
# share of the largest line integral: an edge may have this much although the sample is inside the field of view
_AIR = 0.1
_SURE = 4.0  # standard deviations
# smallest changes that are reported: rows, shares of absorption, width, height; 369 scans at rest reach 5.2 standard
# deviations
_REPEATED, _REPEATED_SIGMAS = np.array([0.5, 0.06, 0.025, 0.03]), 6.0
# a change of the width and of the height by the same factor
_SCALED = ". If the pixel size differs between the two projections, the sample also seems larger or smaller"
_COMPARED = ("higher", "lower"), ("less absorbing", "more absorbing"), ("narrower", "wider"), ("shorter", "taller")


@dataclass(frozen=True)
class ConsistencyCondition:
    """A condition that all projections of a sample at rest must meet, and by how much the projections violate it.

    Attributes:
        residual: by how much the condition is violated, in `unit`.
        tolerance: larger residuals are reported. In scans of a sample at rest, hardening, phase, scatter and noise
            cause smaller residuals.
        sentence: what was found, where, and what to do.
    """

    name: str
    residual: float
    tolerance: float
    unit: str
    sentence: str

    @property
    def broken(self) -> bool:
        return self.residual > self.tolerance

    def in_words(self) -> str:
        return f"{self.residual:.3g} {self.unit} (tolerance {self.tolerance:.3g})"


def warn_of_inconsistency(prepared: PreparedProjections, selection: ScanSelection, warn: Warn) -> dict[str, str]:
    """Warn of consistency conditions that the projections violate. Returns the residual of each condition in words, by
    name.

    In a parallel beam, with the sample inside the field of view, moments of the projections check angles, heights,
    turned frames, total absorption and the rotation axis. In other scans, projections of the same rays are compared.
    The moments are not checked if only a part of the rows is used. (In scan 24737 of Diamond, the rows above the metal
    indicate a range of angles that is 14 % too large, for an unknown reason.) Projections in which some pixels have no
    data are left out.
    """
    if 0 < (complete_views := prepared.whole_views).size < prepared.geometry.n_views:
        prepared = prepared.of_views(complete_views)
    geometry = prepared.geometry
    as_measured = prepared.sources.measured is None and prepared.corrected.floored <= _FLOORED
    if geometry.shifts.any() or not geometry.is_straight or complete_views.size < _LEAST_VIEWS or not as_measured:
        return {}
    conditions = _conditions_of(prepared, whole=selection.asked.rows is None)
    for condition in conditions:
        if condition.broken:
            warn(condition.sentence)
    return {condition.name: condition.in_words() for condition in conditions if np.isfinite(condition.residual)}


def _conditions_of(prepared: PreparedProjections, *, whole: bool) -> list[ConsistencyCondition]:
    """The conditions that apply to this scan; `whole`: the data contain all detector rows."""
    geometry, data = prepared.geometry, prepared.seen.data
    view_numbers = spread(np.arange(len(data)), _VIEWS)
    edges, frames = reach_of(prepared.seen).edges, prepared.ids
    wider_than_field = edges.beyond() or edges.passing()
    faintness, air_is_off = _faintness_and_air(data, view_numbers)
    conditions = list[ConsistencyCondition]()
    if geometry.rows_show_slices and not (geometry.is_off_middle and covers_the_circle(geometry.angles)):
        if wider_than_field or faintness > 1 or air_is_off:
            conditions = [
                _opposite_views(
                    data, view_numbers, geometry.angles[view_numbers], geometry.axis_col, frames[view_numbers]
                )
            ]
        elif data.shape[1] >= _LEAST_ROWS and whole:
            conditions = _conditions_within_the_field(prepared, view_numbers)
    if geometry.is_cone and not wider_than_field and covers_the_circle(geometry.angles):
        conditions.append(_roll_of_axis(data, view_numbers, geometry))
    if not wider_than_field and not air_is_off and covers_the_circle(geometry.angles):
        conditions.append(_fan_angle(data, view_numbers, geometry))
    if (wider_than_field or not air_is_off) and not any(condition.broken for condition in conditions):
        conditions.append(_sample_unchanged(data, geometry, frames, max(faintness, 1.0)))
    return conditions


def _conditions_within_the_field(
    prepared: PreparedProjections, view_numbers: NDArray[np.intp]
) -> list[ConsistencyCondition]:
    """Conditions for parallel projections that show the whole sample, from a subset of the projections."""
    geometry, data = prepared.geometry, prepared.seen.data
    angles, frames = geometry.angles[view_numbers], prepared.ids[view_numbers]
    moments = moments_of((data[view] for view in view_numbers), angles, geometry.axis_col)
    mass_noise, centre_noise = _noise_of(
        prepared, [data[view] for view in view_numbers[:: max(1, view_numbers.size // _COLUMN_VIEWS)]]
    )
    moments = replace(moments, col_shift_sigma=float(np.hypot(moments.col_shift_sigma, centre_noise)))
    masses = _total_absorption(moments, angles, frames, mass_noise)
    if masses.broken:  # such projections falsify the other moments
        return [masses]
    same_axis = abs(moments.axis_col - geometry.axis_col) <= _SAME_AXIS
    angle_scale = _scale_of_angles(moments, geometry.angles)
    if ends := _ends_of_turn(data, geometry, moments.stretch):
        angle_scale = replace(angle_scale, tolerance=_ANGLE_SCALE_TOLERANCE, sentence=f"{ends} {angle_scale.sentence}")
    return [masses, _centre_of_mass(moments), _row_absorption(moments), *([angle_scale] if same_axis else [])]


def compare_with_flats(
    scan: SelectedScan, projections: Projections, warn: Warn, *, refused: bool = True
) -> dict[str, str]:
    """Warn if the intensity of projections does not match their flats. Returns in words how bright the air is relative
    to the flats.

    Args:
        refused: True: a difference that is too large for any beam is an error.

    Raises:
        DataError: the difference is larger than any beam's, and the flats and darks are checked.
    """
    evidence = scan.evidence
    if evidence.dark_and_flat is None or not len(projections.data):
        return {}
    stated_by_user = scan.selection.step(Air).model != "auto"  # the user states which columns are air
    if any(projections.air_columns):
        level = -float(np.log(np.median(projections.air)))
    else:
        columns = [
            np.median(projections.data[view], axis=0)
            for view in spread(np.arange(len(projections.data)), _COLUMN_VIEWS)
        ]
        level = float(np.median(columns, axis=0).min())
    air = any(projections.air_columns)
    for finding in check_air_level(evidence, level, air, evidence.request.accepted or stated_by_user or not refused):
        refuse(scan.source, [finding])
        warn(finding.message)
    return {"air beside the flats": f"{level:+.3f} in line integral (tolerance {WARN:g})"} if air else {}


def _faintness_and_air(data: F32, view_numbers: NDArray[np.intp]) -> tuple[float, bool]:
    """Two facts from the edges: how weakly the sample absorbs, and whether the air is far from zero.

    Returns:
        Two values. (1) The faintness. If it is above 1, material that extends beyond the field of view may go
        unnoticed, because it is corrected as air; the moments are then not valid. (2) True if the edges are far from 0,
        for example because the beam drifts and --air does not correct it. Air then contributes to the moments.
    """
    edges = np.abs([np.median(data[view][:, [0, -1]]) for view in view_numbers])
    deepest = float(np.median([data[view].max() for view in view_numbers]))
    return _FAINT / max(deepest, 1e-6), float(np.percentile(edges, _PERCENTILES[1])) > _AIR * deepest


def _noise_of(prepared: PreparedProjections, views: Sequence[F32]) -> tuple[float, float]:
    """Standard deviations of the total absorption of a projection, and of its centre of mass in columns.

    The first comes from the noise of the pixels and of the air by which the projection was divided. The second comes
    from the slope of the line through that air, which is the same for all rows.
    """
    mass = float(np.median([view.sum(dtype=np.float64) for view in views]))
    if not mass > 0:
        return np.inf, np.inf
    rows, cols = views[0].shape
    air_pixels = [rows * columns for columns in prepared.corrected.air_columns if columns]
    pixels = rows * cols + ((rows * cols) ** 2 * np.pi / 2 / sum(air_pixels) if air_pixels else 0.0)
    slope_factor = rows * cols**2 / 12 * float(np.sqrt(sum(1 / n for n in air_pixels))) if len(air_pixels) > 1 else 0.0
    # only these are read, because all together may not fit in memory
    sampled = views[:: max(1, len(views) // NOISE_VIEWS)][:NOISE_VIEWS]
    noise = noise_level(np.stack(sampled)) / mass
    return noise * float(np.sqrt(pixels)), noise * slope_factor


def _opposite_views(
    data: F32, view_numbers: NDArray[np.intp], angles: F64, axis_col: float, frames: NDArray[np.int64]
) -> ConsistencyCondition:
    """Projections that are 180° apart must be mirror images. This condition is used if no air shows the intensity."""
    reach = int(min(axis_col, data.shape[2] - 1 - axis_col))
    both_sides = slice(round(axis_col) - reach, round(axis_col) + reach + 1)
    levels = np.array([np.median(data[view][:, both_sides]) for view in view_numbers])
    steps = np.diff(levels)
    from_opposite = np.abs(np.abs(angles[:, None] - angles) - np.pi)
    opposite = from_opposite <= 1.01 * float(np.median(np.abs(np.diff(np.sort(angles)))))
    change_nearby = np.maximum(np.append(np.abs(steps), 0), np.append(0, np.abs(steps)))
    unexplained_change = np.where(
        opposite, np.abs(levels[:, None] - levels) - _OF_LOCAL * np.maximum(change_nearby[:, None], change_nearby), -1
    )
    first, last = np.unravel_index(int(unexplained_change.argmax()), unexplained_change.shape)
    difference_found = float(max(unexplained_change[first, last], 0)) if opposite.any() else np.nan
    earlier, later = sorted(frames[[first, last]])
    difference = abs(levels[first] - levels[last])
    difference_text = (
        f"Frames {earlier} and {later}, 180° apart, must be mirror images, but they differ by {difference:.2f} in "
        "line integral"
    )
    outlier, outlier_size = _outlier_in_angle(levels, angles)
    if outlier_size > max(_INTENSITY_STEP, np.nan_to_num(difference_found)):
        difference_found = outlier_size
        odd_frame = frames[outlier]
        difference_text = (
            f"Frame {odd_frame} as a whole is brighter or darker than the frames at neighbouring angles: the median "
            f"of its line integrals jumps by {outlier_size:.2f} more than is usual between neighbouring frames of this "
            "scan"
        )
    sentence = (
        f"{difference_text}. The intensity, the exposure time, the energy or the filter changed, or some projections "
        "belong to another scan. The program cannot correct this, because no detector column shows air next to the "
        "sample. Use --views to choose projections that belong together, or --air to state which columns are air."
    )
    return ConsistencyCondition(
        "light of opposite views", difference_found, _INTENSITY_STEP, "in line integral", sentence
    )


def _outlier_in_angle(levels: F64, angles: F64) -> tuple[int, float]:
    """The projection that differs most from its neighbours in angle, and by how much more than its neighbours differ
    from theirs.
    """
    order = np.argsort(angles, kind="stable")
    steps = np.diff(levels[order])
    step_to, step_from = steps[1:-2], steps[2:-1]
    steps_nearby = np.maximum(np.abs(steps[:-3]), np.abs(steps[3:]))
    dense_angles = sliding_window_view(np.diff(angles[order]), 4).max(axis=1) < _BESIDE
    excess = np.minimum(np.abs(step_to), np.abs(step_from)) - _OF_LOCAL * steps_nearby
    excess[(step_to * step_from > 0) | ~dense_angles] = 0
    return int(order[excess.argmax() + 2]), float(excess.max())


def _total_absorption(
    moments: ViewMoments, angles: F64, frames: NDArray[np.int64], noise: float
) -> ConsistencyCondition:
    """The total absorption must be the same in all projections, except for beam hardening along the longer side of a
    sample, which varies twice per turn.
    """
    basis = np.column_stack([np.ones_like(angles), np.cos(2 * angles), np.sin(2 * angles)])
    residual = moments.mass - basis @ np.linalg.lstsq(basis, moments.mass, rcond=None)[0]
    low, high = np.percentile(residual, _TENTHS)
    tolerance = max(_ABSORPTION_RANGE, 2 * _NOISE * noise)
    limit = max(_ABSORPTION_OUTLIER, _OUTLIERS * median_deviation(moments.mass))
    outliers = np.abs(moments.mass) > limit
    rule = "a sample inside the field of view has the same total absorption in all projections"
    if outliers.any() and (high - low <= tolerance or outliers.mean() < _FEW):
        largest = moments.mass[outliers][np.abs(moments.mass[outliers]).argmax()]
        how_many = count(int(outliers.sum()), "projection")
        odd_frames = frames_text(frames[outliers])
        differ = "differs" if outliers.sum() == 1 else "differ"
        sentence = (
            f"Look at these frames: {how_many} of {outliers.size} checked ({odd_frames}) {differ} from the other "
            f"projections by up to {largest:+.1%} in total absorption, but {rule}. Something other than the sample was "
            "in the beam, or the intensity is wrong. Use --views to leave these projections out."
        )
        return ConsistencyCondition(
            "mass of the views", float(abs(largest)), limit, "of the total absorption", sentence
        )
    change = np.ptp(np.percentile(moments.mass, _TENTHS))
    lowest_frame, highest_frame = frames[moments.mass.argmin()], frames[moments.mass.argmax()]
    sentence = (
        f"The total absorption changes by {change:.0%} during the scan (lowest in frame {lowest_frame}, highest in "
        f"frame {highest_frame}), but {rule}. Did the energy or the sample change, or do some projections belong to "
        "another scan, exposure or flat field? Use --views to choose projections that belong together (every:2 if two "
        "intensities alternate), or --volumes if the sample changes."
    )
    return ConsistencyCondition("mass of the views", float(high - low), tolerance, "of the total absorption", sentence)


def _roll_of_axis(data: F32, view_numbers: NDArray[np.intp], geometry: Geometry) -> ConsistencyCondition:
    """In a 360° scan the mean projection is its own mirror image about the axis, also in a cone beam."""
    weights = circle_weights(geometry.angles[view_numbers]) / (2 * math.pi)
    mean = np.zeros(data.shape[1:])
    for view, weight in zip(view_numbers, weights, strict=True):
        mean += weight * data[view]
    roll, sigma = roll_of_mean_view(mean, geometry.axis_col)
    if math.isnan(sigma):
        return ConsistencyCondition("mirror images of a turn", math.nan, MATTERS, "px of tilt", "")
    rows, tolerance = len(mean), max(MATTERS, _SURE * sigma * len(mean))
    offset_px = abs(roll) * rows
    sentence = (
        "Use --calibrate axis,roll with an iterative method, such as -m fista-tv: the rotation axis seems to be "
        f"tilted in the detector's plane by {tilt_text(roll, sigma)}, {offset_px:.1f} px over {rows} rows. Without "
        "this correction, edges are doubled in the first and last slices."
    )
    return ConsistencyCondition("mirror images of a turn", abs(roll) * rows, tolerance, "px of tilt", sentence)


def _fan_angle(data: F32, view_numbers: NDArray[np.intp], geometry: Geometry) -> ConsistencyCondition:
    """Rays measured from both sides in a 360° scan must agree; checked in the rows next to the plane of the source."""
    middle_row = int(np.clip(geometry.axis_row if geometry.is_cone else data.shape[1] / 2, 0, data.shape[1] - 1))
    rows = slice(max(middle_row - _BESIDE_ROW, 0), middle_row + _BESIDE_ROW + 1)
    pitch, half_width = geometry.pixel_pitch, max(geometry.axis_col, data.shape[2] - 1 - geometry.axis_col)
    stated_slope = pitch / geometry.sdd if geometry.is_cone else 0.0
    sinogram = data[view_numbers][:, rows].mean(axis=1, dtype=np.float64)
    mismatch_stated, mismatch_best, mismatch_typical, best_slope = fans_shown(
        sinogram, geometry.angles[view_numbers], geometry.axis_col, stated_slope
    )
    stated_angle, best_angle = (2 * math.degrees(math.atan(slope * half_width)) for slope in (stated_slope, best_slope))
    distance_text = (
        f" ({pitch / best_slope:.3g} mm from source to detector)" if geometry.is_cone and best_slope > 0 else ""
    )
    check = (
        "Check --cone SOD:SDD: both are in mm, and SDD is the distance from the source to the detector, "
        "not from the axis."
        if geometry.is_cone
        else "If the beam is a cone, give --cone SOD:SDD in mm. Without these distances, densities and shapes are "
        "wrong."
    )
    sentence = (
        f"{check} The projections contradict the stated geometry. A 360° scan measures each ray twice, from opposite "
        f"sides. The two values agree best if the fan angle is {best_angle:.3g} degrees{distance_text}, but the stated "
        f"distances give a fan angle of {stated_angle:.3g} degrees."
    )
    slope_from_axis = pitch / (geometry.sdd + geometry.sod) if geometry.is_cone else np.inf  # SDD stated from the axis
    stated_from_axis = abs(math.atan(best_slope * half_width) - math.atan(slope_from_axis * half_width)) <= _SAME_FAN
    factor = _OFTEN_BY_AXIS if stated_from_axis else _OFTEN
    one_fan_agrees = mismatch_best < min(_AGREE, mismatch_typical / 2)  # a round sample agrees with every fan
    certain = one_fan_agrees and mismatch_stated > factor * mismatch_best
    return ConsistencyCondition(
        "rays from both sides", abs(best_angle - stated_angle) if certain else np.nan, _FAN, "degrees of fan", sentence
    )


def _centre_of_mass(moments: ViewMoments) -> ConsistencyCondition:
    lowest, highest = np.percentile(moments.col_shift, _PERCENTILES)
    deviation = highest - lowest
    sentence = (
        "The sample or the stage moved sideways, or frames have wrong angles: the centre of mass deviates by "
        f"{deviation:.1f} columns (uncertainty {moments.col_shift_sigma:.2g}) from the sine curve of a rotating "
        "sample. Use --calibrate shifts or --poses to correct the shifts, or --volumes if the sample changes."
    )
    tolerance = max(_LEAST_COL_SHIFT, 2 * _NOISE * moments.col_shift_sigma)
    return ConsistencyCondition("centre of mass on a sine", float(deviation), tolerance, "columns", sentence)


def _row_absorption(moments: ViewMoments) -> ConsistencyCondition:
    low, high = np.percentile(moments.row_shift, _PERCENTILES)
    motion, at_first, at_last = high - low, moments.row_shift[0], moments.row_shift[-1]
    sentence = (
        f"Slices are blurred vertically: the sample moves along the rotation axis by up to {motion:.1f} rows between "
        f"projections ({at_first:+.1f} rows in the first projection, {at_last:+.1f} rows in the last; uncertainty "
        f"{moments.row_shift_sigma:.2g}). For a sample at rest, each row has the same total absorption in all "
        "projections. Use --calibrate shifts or --poses if the sample or the stage moved, or --volumes if the sample "
        "changes."
    )
    determined = np.isfinite([*moments.row_shift, moments.row_shift_sigma]).all()
    tolerance = max(_HALF_A_PIXEL, 2 * _NOISE * moments.row_shift_sigma)
    return ConsistencyCondition(
        "mass of each row", float(motion) if determined else np.nan, tolerance, "rows", sentence
    )


def _scale_of_angles(moments: ViewMoments, angles: NDArray[np.floating]) -> ConsistencyCondition:
    span = float(np.degrees(np.ptp(angles)))
    seen_span = span * (1 + moments.stretch)
    sentence = (
        f"The angles seem wrong: according to the moments of their rows, the projections cover {seen_span:.4g} "
        f"degrees, but the stated angles cover {span:.4g} degrees (difference {moments.stretch:+.1%} ± "
        f"{moments.stretch_sigma:.1%}). Do the angles have another scale or range, are projections missing within the "
        "scan, or did the sample move? Give the right angles with --angles FILE (degrees, one per line), or compare "
        "slices made with different angles."
    )
    tolerance = max(_ANGLE_SCALE_TOLERANCE, _SURE * moments.stretch_sigma)
    return ConsistencyCondition(
        "moments, scale of the angles", abs(moments.stretch), tolerance, "of the angles", sentence
    )


def _ends_of_turn(data: F32, geometry: Geometry, stretch: float) -> str:
    """A sentence if the ends of a 180° or 360° scan are counted wrongly: either the stated angles include both ends and
    the projections do not, or the reverse.

    The error is found from the first and the last projection, and from the difference between the measured and the
    stated range of angles.
    """
    order = np.argsort(geometry.angles, kind="stable")
    (first, second, *_, last_but_one, last), span = order, float(np.ptp(geometry.angles))
    step = span / (order.size - 1)
    closed = abs(math.remainder(span, math.pi)) < abs(math.remainder(span + step, math.pi))
    turn = span if closed else span + step
    if abs(math.remainder(turn, math.pi)) > step / 10 or not 0 < round(turn / math.pi) <= 2:
        return ""
    cols = np.arange(data.shape[2])
    ray_cols = cols if round(turn / math.pi) == 2 else 2 * geometry.axis_col - cols
    last_at_rays = np.stack([np.interp(ray_cols, cols, row) for row in data[last]])
    change = float(np.square(last_at_rays - data[first]).mean())
    step_change = (np.square(data[second] - data[first]).mean() + np.square(data[last] - data[last_but_one]).mean()) / 2
    # the difference is 0 plus noise if both see the same ray, and 1 if they are a step apart
    same_rays = change < step_change / 2
    if same_rays == closed or not abs(stretch * order.size + (1 if closed else -1)) < _OF_A_STEP:
        return ""
    compared_text = "directions one step apart" if closed else "the same rays"
    include_or_not = "include" if closed else "do not include"
    large_or_small = "too large" if closed else "too small"
    return (
        f"The first and the last projection show {compared_text}, but the stated angles {include_or_not} both ends of "
        f"{math.degrees(turn):.4g} degrees. The angular step is {large_or_small}, by one part in {order.size}."
    )


def _sample_unchanged(data: F32, geometry: Geometry, frames: NDArray[np.int64], factor: float) -> ConsistencyCondition:
    """Projections of the same rays, early and late in the scan, must show the same sample, in any beam and for any
    sample width.

    Args:
        factor: factor on the smallest changes that are reported, because a beam whose shape drifts looks like them.
    """
    worst, sentence = np.nan, ""
    for (first, later), time_between, change, sigma in changes_seen(data, geometry):
        relative_change = np.where(
            np.abs(change) > _REPEATED_SIGMAS * sigma, np.abs(change) / (_REPEATED * factor * time_between), 0.0
        )
        sizes = f"{abs(change[0]):.1f} rows", *(f"{abs(share):.1%}" for share in change[1:])
        words = [
            f"{size} {directions[int(value > 0)]}"
            for size, directions, value in zip(sizes, _COMPARED, change, strict=True)
        ]
        if not relative_change.max() <= worst:
            worst = float(relative_change.max())
            changes = ", ".join(np.array(words)[relative_change > 1])
            or_scaled = _SCALED if relative_change[2] > 1 and change[2] * change[3] > 0 else ""
            early_frame = frames[first]
            late_frame = frames[later]
            sentence = (
                f"The sample changed during the scan: frames {early_frame} and {late_frame} measure the same rays at "
                f"two times, and in frame {late_frame} the sample is {changes}{or_scaled}. Other pairs of frames of "
                "the same rays show the same change. A single volume blurs everything that changes. Use --volumes N "
                "for several volumes in time, --calibrate shifts if the sample moved as a whole, or --views for a "
                "part of the scan."
            )
    return ConsistencyCondition(
        "views of the same rays", worst, 1.0, "times the smallest change that is reported", sentence
    )
