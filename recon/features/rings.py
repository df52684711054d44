"""Rings: removes the stripes in sinograms (rings in slices) that come from pixels with a wrong sensitivity.

A sinogram is float32 [view, col]: the line integrals of one detector row in the order of the angles. A stripe is a
column of a sinogram. If the projections cover a small angle, stripes cannot be distinguished from edges of the sample.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import maximum_filter1d, median_filter, uniform_filter1d

from recon.base.arrays import F32, median_deviation
from recon.base.choices import Rings
from recon.base.declared_types import check_arguments
from recon.base.stripes import AT_AXIS, NARROWEST, steadiness, without_layers
from recon.base.units import warn_of_other_quantity

_ROBUST = 1.4826  # 1 / MEDIAN, rounded. Reference volumes of the tests depend on this rounding in `by_sorting`
# a column that differs from its neighbours by this many standard deviations is a stripe (Vo 2018: snr 3)
_STRIPE_DEVIATIONS = 3.0
_FEWEST_VIEWS = 8
_LARGEST_STRIPE_SHARE = 0.1  # largest share of columns that may be stripes
# largest ratio of standard deviation to shift; a stripe has nearly the same shift in all projections
_LARGEST_VARIATION = 0.4
_EXAMINED_ROWS = 8  # number of rows examined
_SINOGRAM_COPIES = 13  # float32 copies of a sinogram in memory


def width_for(cols: int) -> int:
    """Number of columns for a median: odd, wider than small stripes, and narrower than the sample.

    Examples: 31 for a detector of 2048 columns, 7 for 160 columns, 3 for 40 columns.
    """
    return 2 * round(max(cols * 0.015, min(6.0, cols / 24)) / 2) + 1


def by_sorting(sinogram: F32, width: int | None = None) -> F32:
    """Remove small and medium stripes by a median across columns, after sorting the values of each column.

    A stripe shifts all values of its column. After sorting, neighbouring columns are similar, so the difference is the
    stripe (Vo, Atwood & Drakopoulos 2018, Opt. Express 26, 28396, algorithm 3). [our own: a stripe adds about the same
    value to all projections, and only this common part is removed; otherwise edges of metal would leave black streaks
    across the slice]
    """
    order = np.argsort(sinogram, axis=0, kind="stable")
    ranked = np.take_along_axis(sinogram, order, axis=0)
    smooth = median_filter(ranked, (1, width or width_for(sinogram.shape[1])), mode="nearest")
    out = np.empty_like(sinogram)
    np.put_along_axis(out, order, smooth, axis=0)
    difference = sinogram - out
    median_difference = np.median(difference, axis=0)
    largest_removed = np.float32(_STRIPE_DEVIATIONS * _noise(sinogram))
    return np.asarray(
        sinogram - np.clip(difference, median_difference - largest_removed, median_difference + largest_removed),
        np.float32,
    )


def without_dead_columns(sinogram: F32) -> F32:
    """Replace columns that hardly respond, or that fluctuate, by interpolated values of their neighbours (Vo et al.
    2018, algorithm 6).

    Such a column varies more, or less, between projections than the median of the columns around it. [our own: the
    variation is a median over projections, because edges of metal cross a column only in a few projections]
    """
    variation = np.median(np.abs(sinogram - uniform_filter1d(sinogram, 11, axis=0, mode="nearest")), axis=0)
    is_dead = _outliers(
        np.log(np.maximum(variation, 1e-12) / np.maximum(_running_median(variation, 4), 1e-12)), 2 * _STRIPE_DEVIATIONS
    )
    return _filled(sinogram, is_dead)


def without_large_stripes(sinogram: F32) -> F32:
    """Shift wide or strong stripes to the level of their neighbours (Vo et al. 2018, algorithm 5, in line integrals).

    A column is changed only if its sorted values differ from those of the columns around it by more than three times
    the noise of a pixel. The values must also differ by about the same amount everywhere in their middle four fifths.
    If a tenth of all columns meet these two conditions, no column is changed. [our own: the second condition; without
    it, metal near the axis would count as a stripe]
    """
    ranked = np.sort(sinogram, axis=0)
    smooth = median_filter(ranked, (1, 2 * width_for(sinogram.shape[1]) + 1), mode="nearest")
    n_omitted = len(ranked) // 10
    difference = (ranked - smooth)[n_omitted : len(ranked) - n_omitted]
    shift = difference.mean(axis=0)
    is_stripe = np.abs(shift) > _STRIPE_DEVIATIONS * max(_noise(sinogram), median_deviation(shift))
    is_stripe &= difference.std(axis=0) < _LARGEST_VARIATION * np.abs(shift)
    if is_stripe.mean() > _LARGEST_STRIPE_SHARE:
        return sinogram  # a tenth of all columns must belong to the sample
    return sinogram - np.where(is_stripe, shift, 0).astype(np.float32)


def by_vo(sinogram: F32) -> F32:
    """Remove dead columns, then large stripes, then small ones (Vo et al. 2018, section 3.7)."""
    return by_sorting(without_large_stripes(without_dead_columns(sinogram)))


REMOVERS: Mapping[str, Callable[[F32], F32]] = MappingProxyType({"sort": by_sorting, "vo": by_vo})
"""Ways to remove stripes, by name."""
_NAMES: Mapping[Callable[[F32], F32], str] = {
    by_sorting: "sort",
    without_dead_columns: "dead columns",
    without_large_stripes: "large stripes",
}


def stripe_score(sinogram: F32) -> float:
    """Typical difference of a column from its four neighbours, divided by the noise of the column. It is about 1
    without stripes.

    The difference is a median over projections. So edges of the sample do not count, because they cross a column only
    in a few projections. A body on the axis stays in its columns, so it counts as a stripe.
    """
    x = sinogram
    difference = (x[:, 2:-2] - (x[:, :-4] + x[:, 1:-3] + x[:, 3:-1] + x[:, 4:]) / 4) / math.sqrt(1.25)
    noise = _noise(difference)
    column_medians = np.median(difference, axis=0)
    roughness = np.diff(column_medians, 2) / math.sqrt(6)  # a large body changes slowly from column to column
    spread = _ROBUST * np.median(np.abs(roughness))
    return float(spread / max(noise * math.sqrt(math.pi / 2 / len(x)), 1e-12))


@dataclass(frozen=True, eq=False)
class WithoutRings:
    """Line integrals with the stripes removed.

    Attributes:
        data: float32 [view, row, col], line integrals.
        taken: float32 [row, col], the part that was removed from the line integrals, averaged over the projections.
        sentence: a sentence that says which stripes were removed.
    """

    data: F32
    taken: F32
    sentence: str


def remove_rings(
    projections: ArrayLike,
    angles: ArrayLike,
    rings: Rings = "auto",
    axis_col: float | None = None,
) -> WithoutRings:
    """A copy of line integrals without the stripes that cause rings. Call `remove_rings` after `recon.correct` and
    before a reconstruction.

    Args:
        projections: [view, row, col], in any order; with fewer than 8 projections, or fewer than 64 columns, the data
            are not changed.
        angles: [view], radians.
        rings: "sort": small and medium stripes (Vo et al. 2018, algorithm 3); "vo": also dead columns and large
            stripes; "none": no removal; "auto": chosen from the data.
        axis_col: column of the rotation axis; None: the middle.

    Raises:
        ValueError: shapes do not match, values are not finite, or `rings` is unknown.
    """
    check_arguments(remove_rings, locals())
    views, theta = np.array(projections, np.float32), np.asarray(angles, np.float64)
    if views.ndim != 3 or theta.shape != views.shape[:1]:
        raise ValueError(
            f"projections must be [view, row, col] with one angle for each projection, got shapes {views.shape} and "
            f"{theta.shape}"
        )
    if not (np.isfinite(views).all() and np.isfinite(theta).all()):
        raise ValueError("projections or angles contain NaN or infinite values; correct them first")
    warn_of_other_quantity(views)
    return WithoutRings(views, *remove_rings_in_place(views, theta, rings, axis_col))


def remove_rings_in_place(
    views: F32, angles: NDArray[np.float64], rings: Rings, axis_col: float | None = None
) -> tuple[F32, str]:
    """Remove stripes from all rows of line integrals [view, row, col], in place.

    Args:
        views: in any order. Projections are not changed if they are fewer than 8, or if they have fewer than 64
            columns.
        angles: [view], radians.
        rings: the method. "auto" examines some rows: it uses "sort" if `steadiness` finds stripes, and it removes
            columns that are dead or deviate strongly.
        axis_col: column of the rotation axis; None: the middle. The part that a column shares with the mirrored column
            is not removed, see `without_layers`.

    Returns:
        float32 [row, col], the removed part averaged over the projections; and a sentence that describes the removal
        ("" for "none").
    """
    removed = np.zeros(views.shape[1:], np.float32)
    if rings == "none":
        return removed, ""
    if len(views) < _FEWEST_VIEWS or views.shape[2] < NARROWEST:
        return removed, (
            f"Rings: nothing was removed. {len(views)} projections of {views.shape[2]} columns are too few to "
            f"distinguish stripes from the "
            f"sample (at least {_FEWEST_VIEWS} projections of {NARROWEST} columns are needed)."
        )
    order = np.argsort(angles, kind="stable")
    axis = (views.shape[2] - 1) / 2 if axis_col is None else axis_col
    rows = _examined_rows(views)
    score_before = _typical_score(views[np.ix_(order, rows)])
    stages = (REMOVERS[rings],) if rings != "auto" else _removers_for(views[np.ix_(order, rows)], axis)
    if not stages:
        return removed, "Rings: nothing was removed, because the detector causes no visible stripes."
    for row in range(views.shape[1]):
        stripes = clean = views[order, row]
        for remove in stages:
            clean = remove(clean)
        level = np.median(stripes - clean, axis=0)
        clean = clean + (level - without_layers(level[None], axis)[0])
        removed[row] = (stripes - clean).mean(axis=0)
        views[order, row] = clean
    score_after = _typical_score(views[np.ix_(order, rows)])
    names_of_removers = ", ".join(_NAMES.get(remove, rings) for remove in stages)
    return removed, (
        f"Rings: removed by {names_of_removers}. The height of the stripes fell from {score_before:.1f} to "
        f"{score_after:.1f} times the noise of a column."
    )


# share of the largest line integral; fainter stripes are visible only in projections without noise
_FAINTEST_STRIPE = 1e-5


def rings_seen(views: F32, angles: NDArray[np.float64], axis_col: float) -> str:
    """A warning with advice if pixel sensitivities differ so much that rings are visible; otherwise ""."""
    if len(views) < _FEWEST_VIEWS or views.shape[2] < NARROWEST:
        return ""
    steady = steadiness(views[np.ix_(np.argsort(angles, kind="stable"), _examined_rows(views))], axis_col)
    if steady is None or not steady.stripes or steady.odd < _FAINTEST_STRIPE * float(np.abs(views).max()):
        return ""
    difference, noises = steady.odd, steady.score
    return (
        f"Expect ring artefacts: pixel sensitivities differ by {difference:.2g} in line integral, {noises:.1f} times "
        "the noise of a column. No stripes were removed from the projections. To remove the rings, use --rings auto, "
        "which filters the projections. If the scan is finished, you can use --calibrate gains instead, which measures "
        "the sensitivities with the volume. If the sample has layers around the rotation axis, compare the volumes "
        "with and without removal of rings, because layers look like rings."
    )


def _examined_rows(views: F32) -> NDArray[np.intp]:
    return np.unique(np.linspace(0, views.shape[1] - 1, min(views.shape[1], _EXAMINED_ROWS)).astype(np.intp))


def _typical_score(sinograms: F32) -> float:
    return float(np.median([stripe_score(sinograms[:, row]) for row in range(sinograms.shape[1])]))


def _removers_for(sinograms: F32, axis_col: float) -> tuple[Callable[[F32], F32], ...]:
    """The removal functions, in order, for the detector stripes in these rows [view, row, col]."""
    steady = steadiness(sinograms, axis_col)
    for_strong = (without_dead_columns, without_large_stripes)
    has_strong = any(_has_strong_stripes(sinograms[:, row], axis_col) for row in range(sinograms.shape[1]))
    return (for_strong if has_strong else ()) + ((by_sorting,) if steady is not None and steady.stripes else ())


def removal_memory(views: int, shape: tuple[int, int], rings: Rings) -> int:
    """Peak memory of `remove_rings_in_place` in bytes, without the projections, for a detector (rows, cols)."""
    rows, cols = shape
    examined = views * min(rows, _EXAMINED_ROWS) * cols
    if rings == "none" or views < _FEWEST_VIEWS or cols < NARROWEST:
        return 4 * (rows * cols + examined)
    return 4 * (rows * cols + examined + _SINOGRAM_COPIES * views * cols)


def _noise(values: NDArray[np.floating]) -> float:
    """Robust standard deviation between projections, from second differences."""
    return float(_ROBUST * np.median(np.abs(np.diff(values, 2, axis=0))) / math.sqrt(6))


def _has_strong_stripes(sinogram: F32, axis_col: float) -> bool:
    """Whether some columns are dead or deviate strongly. Such columns are at most a fifth of all, are not near the
    axis, and their mirrored columns do not deviate."""
    cleaned = without_large_stripes(without_dead_columns(sinogram))
    changed = (cleaned != sinogram).any(axis=0).sum()
    is_strong = np.abs(cleaned - sinogram).max(axis=0) > 0.1 * max(float(np.ptp(np.median(sinogram, axis=0))), 1e-12)
    columns = np.arange(is_strong.size)
    mirrored_columns = np.rint(2 * axis_col - columns).astype(int)
    is_inside = (mirrored_columns >= 0) & (mirrored_columns < is_strong.size)
    is_mirrored_strong = is_inside & maximum_filter1d(is_strong, 3)[np.clip(mirrored_columns, 0, is_strong.size - 1)]
    is_detector_stripe = is_strong & ~is_mirrored_strong & (np.abs(columns - axis_col) > AT_AXIS)
    return bool(is_detector_stripe.any() and changed <= is_strong.size / 5)


def _running_median(values: NDArray[np.floating], width: int) -> NDArray[np.floating]:
    return np.asarray(median_filter(values, 2 * (width // 2) + 1, mode="nearest"))


def _outliers(values: NDArray[np.floating], limit: float) -> NDArray[np.bool_]:
    deviations = values - np.median(values)
    return np.asarray(np.abs(deviations) > limit * max(median_deviation(deviations), 1e-12))


def _filled(sinogram: F32, is_bad: NDArray[np.bool_]) -> F32:
    """The values with bad columns filled by linear interpolation between good columns. They are unchanged if more than
    half of the columns are bad."""
    if not is_bad.any() or is_bad.mean() > 0.5:
        return sinogram
    good_columns, bad_columns = np.flatnonzero(~is_bad), np.flatnonzero(is_bad)
    next_good = np.clip(np.searchsorted(good_columns, bad_columns), 0, good_columns.size - 1)
    left_columns, right_columns = good_columns[np.clip(next_good - 1, 0, None)], good_columns[next_good]
    place = (bad_columns - left_columns) / np.maximum(right_columns - left_columns, 1)
    right_weight = np.clip(place, 0, 1).astype(np.float32)
    out = sinogram.copy()
    out[:, bad_columns] = (1 - right_weight) * sinogram[:, left_columns] + right_weight * sinogram[:, right_columns]
    return out
