"""Consistency: conditions that hold for all views of a sample at rest, and light that matches its flats."""

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
from beamline.projections.selection import ScanSelection
from beamline.projections.tilt import MATTERS, tilt_text
from beamline.projections.views import refuse
from beamline.storage.rules.evidence import ScanEvidence
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
from recon.voxels.field_edges import FieldEdges
from recon.voxels.view_weights import circle_weights, covers_the_circle

_VIEWS = 180  # more do not sharpen the moments, they only cost reading
_COLUMN_VIEWS = 32  # whose columns are looked at
_LEAST_VIEWS, _LEAST_ROWS = 12, 8  # with fewer rows nobody knows how much they disagree
_HALF_A_PIXEL = 0.5  # doubles edges as far as the resolution, as for the monitor's `opposite`
_MOST_OF_THEM = 5, 95  # percent of views: one that a crumb crosses does not count
_NOISE = 3.3  # standard deviations between these percentiles, of noise alone
_ACROSS = 1.0  # columns: a teapot that hardens by 12 % has 0.7, a measured tooth 0.5
_STEP_OF_LIGHT = 0.1  # of line integral, as the monitor's alarm `gain`
_OF_LOCAL = 3.0  # times the change to the next view, as angles differ by so much
_BESIDE = np.radians(4.1)  # a slab 20 times as long as thick, wider than the field, is no spike in views so dense
_MASS, _OUTLIERS = 0.03, 6.0  # share, as for the monitor's `mass`, and in standard deviations of most views
_MASSES, _TENTHS = 0.06, (10, 90)  # share between these percentiles of views: Diamond 24737 has 0.011, a tooth 0.019
_FEW = 0.2  # of the views: so many are named, however far they are off
_STRETCH = 0.015  # a thorax hardened by 12 % has 0.011, measured scans up to 0.009, 60 other scans at rest less
# Off the turn with both ends, or without, which are a step apart; told of 31 of 40 other scans, falsely of none of 232.
_OF_A_STEP = 1 / 3
_BESIDE_ROW = 8  # rows on both sides of the plane of the source that count as in it
_OFTEN, _AGREE, _FAN = 1.3, 0.01, 2.5  # times the least disagreement, which is a share of the variance; degrees
_SAME_AXIS = 1.0  # columns between the centres' axis and the one used, beyond which angles are not judged
_FAINT = 0.3  # line integral: of matter fainter than that, as much as the air may have at an edge is a large part
_FLOORED = 1e-3  # of the pixels, whose line integrals are too small; they are warned of
_AIR = 0.1  # of the deepest line integral: as much as an edge may have where the sample is in the field
_SURE = 4.0  # standard deviations
# Least changes that are reported: rows, shares of absorption, width, height; 369 scans at rest reach 5.2 sigmas.
_REPEATED, _REPEATED_SIGMAS = np.array([0.5, 0.06, 0.025, 0.03]), 6.0
_SCALED = ", as one also seems to where the pixel size differs from view to view"  # in width and height alike
_COMPARED = ("higher", "lower"), ("less absorbing", "more absorbing"), ("narrower", "wider"), ("shorter", "taller")


@dataclass(frozen=True)
class ConsistencyCondition:
    """A consistency condition of all views of a sample at rest, and the residual that the views leave in it.

    Attributes:
        tolerance: more is reported; by hardening, phase and scatter in scans at rest, and by the views' noise.
        sentence: where and how it is broken, and what to do.
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
    """Warn of consistency conditions that the views violate; returns the residual of each in words, by name.

    Angles, heights, turned frames, masses and an axis that moments of the views disagree with, which hold for a
    parallel beam and a sample within the field; and for others, whether views of the same rays agree. Moments of a part
    of the rows are passed over: those of Diamond
    24737 above its metal seem to turn by 14 % more, for a reason that is not known. Views that measured a part of their
    pixels are left out.
    """
    if 0 < (whole := prepared.whole_views).size < prepared.geometry.n_views:
        prepared = prepared.of_views(whole)
    geometry = prepared.geometry
    known = prepared.measured is None and prepared.projections.floored <= _FLOORED
    if geometry.shifts.any() or not geometry.is_straight or whole.size < _LEAST_VIEWS or not known:
        return {}
    conditions = _conditions_of(prepared, whole=selection.asked.rows is None)
    for condition in conditions:
        if condition.broken:
            warn(condition.sentence)
    return {condition.name: condition.in_words() for condition in conditions if np.isfinite(condition.residual)}


def _conditions_of(prepared: PreparedProjections, *, whole: bool) -> list[ConsistencyCondition]:
    """The conditions that these views have to obey; `whole`: all rows of the detector are there."""
    geometry, data = prepared.geometry, prepared.projections.data
    some = spread(np.arange(len(data)), _VIEWS)
    edges, frames = FieldEdges.of(data, geometry), prepared.projections.view_ids
    wide, (faint, air_is_off) = edges.beyond() or edges.passing(), _faint_or_off(data, some)
    conditions = list[ConsistencyCondition]()
    if geometry.rows_show_slices and not (geometry.is_off_middle and covers_the_circle(geometry.angles)):
        if wide or faint > 1 or air_is_off:
            conditions = [_steady(data, some, geometry.angles[some], geometry.axis_col, frames[some])]
        elif data.shape[1] >= _LEAST_ROWS and whole:
            conditions = _conditions_within_the_field(prepared, some)
    if geometry.is_cone and not wide and covers_the_circle(geometry.angles):
        conditions.append(_lean_of_axis(data, some, geometry))
    if not wide and not air_is_off and covers_the_circle(geometry.angles):
        conditions.append(_fan(data, some, geometry))
    if (wide or not air_is_off) and not any(condition.broken for condition in conditions):
        conditions.append(_at_rest(data, geometry, frames, max(faint, 1.0)))
    return conditions


def _conditions_within_the_field(prepared: PreparedProjections, some: NDArray[np.intp]) -> list[ConsistencyCondition]:
    """Laws of parallel views that show the whole sample, by some of the views."""
    geometry, data = prepared.geometry, prepared.projections.data
    angles, frames = geometry.angles[some], prepared.projections.view_ids[some]
    shown = moments_of((data[view] for view in some), angles, geometry.axis_col)
    of_mass, of_centre = _noise_of(prepared, [data[view] for view in some[:: max(1, some.size // _COLUMN_VIEWS)]])
    shown = replace(shown, across_sigma=float(np.hypot(shown.across_sigma, of_centre)))
    masses = _masses(shown, angles, frames, of_mass)
    if masses.broken:  # such views spoil the other moments
        return [masses]
    near = abs(shown.axis_col - geometry.axis_col) <= _SAME_AXIS
    turn = _angles(shown, geometry.angles)
    if ends := _ends_of_turn(data, geometry, shown.stretch):
        turn = replace(turn, tolerance=_STRETCH, sentence=f"{ends} {turn.sentence}")
    return [masses, _across(shown), _heights(shown), *([turn] if near else [])]


def compare_with_flats(
    scan: ScanEvidence, selection: ScanSelection, projections: Projections, warn: Warn, *, refused: bool = True
) -> dict[str, str]:
    """Warn of views whose light does not match their flats; returns in words how bright their air is relative to the
    flats.

    Args:
        refused: a difference that no beam has is an error.

    Raises:
        DataError: such a difference, and the references are checked.
    """
    if scan.beam is None or not len(projections.data):
        return {}
    said = selection.step(Air).model != "auto"  # columns that are said to be air
    if any(projections.air_columns):
        level = -float(np.log(np.median(projections.air)))
    else:
        columns = [
            np.median(projections.data[view], axis=0)
            for view in spread(np.arange(len(projections.data)), _COLUMN_VIEWS)
        ]
        level = float(np.median(columns, axis=0).min())
    air = any(projections.air_columns)
    for finding in check_air_level(scan, level, air, scan.asked.accepted or said or not refused):
        refuse(scan.source, [finding])
        warn(finding.message)
    return {"air beside the flats": f"{level:+.3f} of line integral (tolerance {WARN:g})"} if air else {}


def _faint_or_off(data: F32, some: NDArray[np.intp]) -> tuple[float, bool]:
    """How faint matter is: above 1 it may leave the field unnoticed, corrected as air, which moments do not bear.
    Whether edges are far from 0, as where the light drifts without --air: such air has moments, too."""
    edges = np.abs([np.median(data[view][:, [0, -1]]) for view in some])
    deepest = float(np.median([data[view].max() for view in some]))
    return _FAINT / max(deepest, 1e-6), float(np.percentile(edges, _MOST_OF_THEM[1])) > _AIR * deepest


def _noise_of(prepared: PreparedProjections, views: Sequence[F32]) -> tuple[float, float]:
    """Standard deviations of a view's mass, by the noise of its pixels and of the air it was divided by, and of its
    centre of mass in columns, by the slope of the line through that air, which all rows share."""
    mass = float(np.median([view.sum(dtype=np.float64) for view in views]))
    if not mass > 0:
        return np.inf, np.inf
    rows, cols = views[0].shape
    air = [rows * columns for columns in prepared.projections.air_columns if columns]
    pixels = rows * cols + ((rows * cols) ** 2 * np.pi / 2 / sum(air) if air else 0.0)
    slope = rows * cols**2 / 12 * float(np.sqrt(sum(1 / n for n in air))) if len(air) > 1 else 0.0
    some = views[:: max(1, len(views) // NOISE_VIEWS)][:NOISE_VIEWS]  # that it reads: all together may not fit
    noise = noise_level(np.stack(some)) / mass
    return noise * float(np.sqrt(pixels)), noise * slope


def _steady(
    data: F32, some: NDArray[np.intp], angles: F64, axis_col: float, frames: NDArray[np.int64]
) -> ConsistencyCondition:
    """Views half a turn apart are mirror images, where no air tells of the light."""
    reach = int(min(axis_col, data.shape[2] - 1 - axis_col))
    around = slice(round(axis_col) - reach, round(axis_col) + reach + 1)
    levels = np.array([np.median(data[view][:, around]) for view in some])
    steps = np.diff(levels)
    apart = np.abs(np.abs(angles[:, None] - angles) - np.pi)
    opposite = apart <= 1.01 * float(np.median(np.abs(np.diff(np.sort(angles)))))
    local = np.maximum(np.append(np.abs(steps), 0), np.append(0, np.abs(steps)))
    change = np.where(opposite, np.abs(levels[:, None] - levels) - _OF_LOCAL * np.maximum(local[:, None], local), -1)
    first, last = np.unravel_index(int(change.argmax()), change.shape)
    size = float(max(change[first, last], 0)) if opposite.any() else np.nan
    what = (
        f"Frames {min(frames[[first, last]])} and {max(frames[[first, last]])}, half a turn apart, see one and the "
        f"same matter, but differ by {abs(levels[first] - levels[last]):.2f} of line integral"
    )
    at, odd = _out_of_line(levels, angles)
    if odd > max(_STEP_OF_LIGHT, np.nan_to_num(size)):
        size, more = odd, f"by {odd:.2f} of line integral more than these change"
        what = f"Frame {frames[at]} differs as a whole from those beside it, {more}"
    sentence = (
        f"{what}, and no air beside the sample corrects it: light, exposure, energy or filter changed, or views of "
        "another scan are among them. Choose views that belong together with --views, or say which columns are air."
    )
    return ConsistencyCondition("light of opposite views", size, _STEP_OF_LIGHT, "of line integral", sentence)


def _out_of_line(levels: F64, angles: F64) -> tuple[int, float]:
    """The view most out of line with its neighbours in angle, and by how much more than these differ otherwise."""
    order = np.argsort(angles, kind="stable")
    steps = np.diff(levels[order])
    there, back = steps[1:-2], steps[2:-1]
    around = np.maximum(np.abs(steps[:-3]), np.abs(steps[3:]))
    dense = sliding_window_view(np.diff(angles[order]), 4).max(axis=1) < _BESIDE
    off = np.minimum(np.abs(there), np.abs(back)) - _OF_LOCAL * around
    off[(there * back > 0) | ~dense] = 0
    return int(order[off.argmax() + 2]), float(off.max())


def _masses(shown: ViewMoments, angles: F64, frames: NDArray[np.int64], noise: float) -> ConsistencyCondition:
    """One mass in all views, but for what hardening makes of the longer side of a sample, twice a turn."""
    parts = np.column_stack([np.ones_like(angles), np.cos(2 * angles), np.sin(2 * angles)])
    rest = shown.mass - parts @ np.linalg.lstsq(parts, shown.mass, rcond=None)[0]
    low, high = np.percentile(rest, _TENTHS)
    tolerance = max(_MASSES, 2 * _NOISE * noise)
    limit = max(_MASS, _OUTLIERS * median_deviation(shown.mass))
    odd = np.abs(shown.mass) > limit
    because = "where a sample within the field has one mass in all views"
    if odd.any() and (high - low <= tolerance or odd.mean() < _FEW):
        most = shown.mass[odd][np.abs(shown.mass[odd]).argmax()]
        sentence = (
            f"{count(int(odd.sum()), 'view')} of {odd.size} looked at ({frames_text(frames[odd])}) with "
            f"{most:+.1%} matter beside the others, at most, {because}: something else stood in the beam, or the light "
            "is wrong. Look at them; --views leaves them out."
        )
        return ConsistencyCondition("mass of the views", float(abs(most)), limit, "of the mass", sentence)
    sentence = (
        f"The mass of the views changes by {np.ptp(np.percentile(shown.mass, _TENTHS)):.0%}, {because}: it is least "
        f"in frame {frames[shown.mass.argmin()]} and greatest in frame {frames[shown.mass.argmax()]}. Did the energy "
        "or the sample change within the scan, or are views of another scan, exposure or reference among them? Choose "
        "views that belong together with --views (every:2, where two lights take turns); --volumes where the sample "
        "changes."
    )
    return ConsistencyCondition("mass of the views", float(high - low), tolerance, "of the mass", sentence)


def _lean_of_axis(data: F32, some: NDArray[np.intp], geometry: Geometry) -> ConsistencyCondition:
    """The law that the mean view of a full turn is its own mirror image about the axis, in a cone, too."""
    weights = circle_weights(geometry.angles[some]) / (2 * math.pi)
    mean = np.zeros(data.shape[1:])
    for view, weight in zip(some, weights, strict=True):
        mean += weight * data[view]
    roll, sigma = roll_of_mean_view(mean, geometry.axis_col)
    if math.isnan(sigma):
        return ConsistencyCondition("mirror images of a turn", math.nan, MATTERS, "px of lean", "")
    rows, least = len(mean), max(MATTERS, _SURE * sigma * len(mean))
    sentence = (
        f"The rotation axis seems to lean by {tilt_text(roll, sigma)} in the detector's plane, {abs(roll) * rows:.1f} "
        f"px over {rows} rows: edges double in the first and last slices. Give --calibrate axis,roll with an iterative "
        "method, such as -m fista-tv."
    )
    return ConsistencyCondition("mirror images of a turn", abs(roll) * rows, least, "px of lean", sentence)


def _fan(data: F32, some: NDArray[np.intp], geometry: Geometry) -> ConsistencyCondition:
    """Rays measured from both sides of a full turn agree, by the rows next to the plane of the source."""
    row = int(np.clip(geometry.axis_row if geometry.is_cone else data.shape[1] / 2, 0, data.shape[1] - 1))
    rows = slice(max(row - _BESIDE_ROW, 0), row + _BESIDE_ROW + 1)
    pitch, across = geometry.pixel_pitch, max(geometry.axis_col, data.shape[2] - 1 - geometry.axis_col)
    stated = pitch / geometry.sdd if geometry.is_cone else 0.0
    sinogram = data[some][:, rows].mean(axis=1, dtype=np.float64)
    off, least, usual, best = fans_shown(sinogram, geometry.angles[some], geometry.axis_col, stated)
    told, shown = (2 * math.degrees(math.atan(slope * across)) for slope in (stated, best))
    away = f" ({pitch / best:.3g} mm from source to detector)" if geometry.is_cone and best > 0 else ""
    check = (
        "Check --cone SOD:SDD: both are in mm, and SDD goes from the source to the detector, not from the axis."
        if geometry.is_cone
        else "If the beam is a cone, give --cone SOD:SDD in mm; without, densities and shapes are wrong."
    )
    sentence = (
        f"The views disagree with the stated geometry: rays that are measured from both sides agree for a fan of "
        f"{shown:.3g} degrees across the detector{away} instead of {told:.3g}. {check}"
    )
    sure = off > _OFTEN * least and least < min(_AGREE, usual / 2)  # a round sample agrees for every fan
    return ConsistencyCondition(
        "rays from both sides", abs(shown - told) if sure else np.nan, _FAN, "degrees of fan", sentence
    )


def _across(shown: ViewMoments) -> ConsistencyCondition:
    left, right = np.percentile(shown.across, _MOST_OF_THEM)
    sentence = (
        f"The centre of mass leaves its way about the axis by {right - left:.1f} columns, from one view to another "
        f"(uncertain by {shown.across_sigma:.2g}): the sample or the stage moved across, or frames are not those of "
        "their angles. Give --calibrate shifts, or --poses; --volumes where the sample changes."
    )
    tolerance = max(_ACROSS, 2 * _NOISE * shown.across_sigma)
    return ConsistencyCondition("centre of mass on a sine", float(right - left), tolerance, "columns", sentence)


def _heights(shown: ViewMoments) -> ConsistencyCondition:
    low, high = np.percentile(shown.down, _MOST_OF_THEM)
    sentence = (
        f"From view to view the matter stands up to {high - low:.1f} rows higher or lower (from {shown.down[0]:+.1f} "
        f"rows in the first view to {shown.down[-1]:+.1f} in the last; uncertain by {shown.down_sigma:.2g}), where "
        "each row of a sample at rest holds one mass in all views: slices are blurred across rows. Give --calibrate "
        "shifts where the sample or the stage moved, or --poses; --volumes where the sample changes."
    )
    known = np.isfinite([*shown.down, shown.down_sigma]).all()
    tolerance = max(_HALF_A_PIXEL, 2 * _NOISE * shown.down_sigma)
    return ConsistencyCondition("mass of each row", float(high - low) if known else np.nan, tolerance, "rows", sentence)


def _angles(shown: ViewMoments, angles: NDArray[np.floating]) -> ConsistencyCondition:
    span = float(np.degrees(np.ptp(angles)))
    sentence = (
        f"The views seem to turn by {span * (1 + shown.stretch):.4g} degrees, and are stated to turn by {span:.4g} "
        f"({shown.stretch:+.1%} ± {shown.stretch_sigma:.1%}, by the moments of their rows). Are the angles those of "
        "another scale or range, are views missing within the scan, or did the sample move? Give the right angles with "
        "--angles FILE (degrees, one a line), or compare slices made with them."
    )
    tolerance = max(_STRETCH, _SURE * shown.stretch_sigma)
    return ConsistencyCondition(
        "moments, scale of the angles", abs(shown.stretch), tolerance, "of the angles", sentence
    )


def _ends_of_turn(data: F32, geometry: Geometry, stretch: float) -> str:
    """A sentence where the angles are spread over half a turn or a turn with both ends, and the views without, or the
    reverse: by what the first and the last view show, and by the excess of the turn over the stated one."""
    order = np.argsort(geometry.angles, kind="stable")
    (first, second, *_, late, last), span = order, float(np.ptp(geometry.angles))
    step = span / (order.size - 1)
    closed = abs(math.remainder(span, math.pi)) < abs(math.remainder(span + step, math.pi))
    turn = span if closed else span + step
    if abs(math.remainder(turn, math.pi)) > step / 10 or not 0 < round(turn / math.pi) <= 2:
        return ""
    cols = np.arange(data.shape[2])
    places = cols if round(turn / math.pi) == 2 else 2 * geometry.axis_col - cols
    again = np.stack([np.interp(places, cols, row) for row in data[last]])
    change = float(np.square(again - data[first]).mean())
    of_step = (np.square(data[second] - data[first]).mean() + np.square(data[last] - data[late]).mean()) / 2
    alike = change < of_step / 2  # 0 and noise where they are of one ray, 1 where they are a step apart
    if alike == closed or not abs(stretch * order.size + (1 if closed else -1)) < _OF_A_STEP:
        return ""
    what = "a step apart" if closed else "of the same rays"
    return (
        f"The first and the last view are {what}, where the stated angles {'have' if closed else 'lack'} both ends of "
        f"{math.degrees(turn):.4g} degrees: the step is {'too large' if closed else 'too small'}, by 1 in {order.size}."
    )


def _at_rest(data: F32, geometry: Geometry, frames: NDArray[np.int64], faint: float) -> ConsistencyCondition:
    """Views of the same rays, early and late, show one sample, in any beam and however wide it is.

    Args:
        faint: the least reported changes are so many times as large: a beam whose shape drifts looks like them.
    """
    worst, sentence = np.nan, ""
    for (first, later), between, change, sigma in changes_seen(data, geometry):
        off = np.where(np.abs(change) > _REPEATED_SIGMAS * sigma, np.abs(change) / (_REPEATED * faint * between), 0.0)
        sizes = f"{abs(change[0]):.1f} rows", *(f"{abs(share):.1%}" for share in change[1:])
        words = [f"{size} {way[int(by > 0)]}" for size, way, by in zip(sizes, _COMPARED, change, strict=True)]
        if not off.max() <= worst:
            worst = float(off.max())
            sentence = (
                f"Frames {frames[first]} and {frames[later]}, as others that see the same rays at two times, show "
                f"another sample: it becomes {', '.join(np.array(words)[off > 1])}"
                f"{_SCALED if off[2] > 1 and change[2] * change[3] > 0 else ''}. One volume blurs what changes: "
                "give --volumes N for several in time, --calibrate shifts where the sample moved as a whole, or "
                "--views for a part of the scan."
            )
    return ConsistencyCondition("views of the same rays", worst, 1.0, "of the least change that is reported", sentence)
