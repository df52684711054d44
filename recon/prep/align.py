"""find_axis: the rotation axis (centre of rotation) from the projections, and whether the estimate is reliable.

There are five methods with different requirements. The method "pair" needs two opposite projections (180° apart) and an
axis near the middle. "opposite views" needs a 360° scan. "double wedge" needs projections over about 180° and a sample
within the field of view. "ends of half a turn" also works if the sample is wider than the field of view, but needs
small steps between projections. "centre of mass" works with any sector, but needs the whole sample in the field of view
and an air level of zero.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft
from scipy.ndimage import uniform_filter1d

from recon.base.declared_types import check_arguments
from recon.base.units import warn_of_degrees, warn_of_other_quantity
from recon.prep.axis_ends import axis_from_ends
from recon.prep.axis_wedge import AGREE, MOST_ROWS, Floats, axis_from_sinogram, few_rows, is_cut_off, lowest, optimum
from recon.prep.axis_wedge import AxisError as AxisError
from recon.prep.axis_wedge import AxisEstimate as AxisEstimate

_FEWEST_PAIRS, _MOST_PAIRS = 8, 64
_FEWEST = 2  # number of columns at each edge in which no axis is accepted
_PAIRINGS = 32  # number of pairings of projections that are not opposite
_PERFECT = 1 - 1e-9
_ALL = slice(None)
_EDGE = 25  # at each edge, one of this many columns is too near to the edge to be an axis


def axis_from_pair(p0: NDArray[np.floating], p180: NDArray[np.floating]) -> AxisEstimate:
    """The rotation axis from two opposite projections. p180 shows the same as p0, mirrored about the axis.

    The normalised correlation of p0 with the mirrored p180 is computed for an axis at every half column, and a parabola
    is fitted to its peak. Mirroring about a half column maps pixels to pixels, so no value is interpolated. The sample
    may be wider than the field of view, because only columns that both projections see are compared.

    Args:
        p0, p180: float32 [row, col], line integrals.

    Raises:
        ValueError: the shapes differ, or values are not finite.
        AxisError: the best match lies at the edge of the candidates.
    """
    a, b = np.atleast_2d(p0).astype(np.float64), np.atleast_2d(p180).astype(np.float64)
    if a.shape != b.shape:
        raise ValueError(f"the two projections must have the same shape, got {a.shape} and {b.shape}")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError("the two projections contain NaN or infinite values; correct them first")
    cols = a.shape[1]
    rows = np.unique(np.linspace(0, len(a) - 1, min(len(a), 4 * MOST_ROWS)).astype(int))
    candidates = np.arange(cols // 8 * 2, 2 * cols - 1 - cols // 8 * 2) / 2
    curve = mirror_mismatch(a[rows], b[rows], candidates)
    value, depth = optimum(candidates, curve)
    confident = depth > 0.5
    if confident and rows.size >= 8:
        halves = [mirror_mismatch(a[part], b[part], candidates) for part in (rows[::2], rows[1::2])]
        confident = max(abs(lowest(candidates, half)[0] - value) for half in halves) < AGREE
    return AxisEstimate(value, candidates, curve, confident, "pair")


def axis_from_opposites(projections: NDArray[np.floating], angles: Floats) -> AxisEstimate:
    """The rotation axis from all pairs of opposite projections of a 360° scan. The axis may be near an edge of the
    detector.

    The method is that of `axis_from_pair`, with the slopes of the projections along the columns in place of their
    values. If the overlap is narrow, a common trend of the values would give a false match. The part that all
    projections share, such as the rim of a round sample, is subtracted. The correlation is summed over up to 64 pairs
    and over rows (overlap in half acquisition: Vo et al. 2021, Opt. Express 29, 17849). A few columns can agree by
    chance, so a candidate is scored by Fisher's z = artanh(correlation) √columns. For comparison, each projection is
    paired with a projection of another pair, which is not opposite to it, in up to 32 ways. The estimate is confident
    if its z exceeds the largest z of any candidate in all of these pairings. By chance this happens in one of 33 scans.

    Args:
        projections: float32 [view, row, col], line integrals.
        angles: [view], radians.

    Raises:
        ValueError: there are fewer than 8 pairs of opposite projections, or values are not finite.
        AxisError: the best match lies at the edge of the candidates.
    """
    a, b = _opposites(projections, angles)
    cols = projections.shape[2]
    candidates = np.arange(2 * _FEWEST, 2 * (cols - 1 - _FEWEST) + 1) / 2
    root_columns = np.sqrt(np.minimum(2 * candidates, 2 * (cols - 1 - candidates)))

    mirrored = _Mirrored.of(_rows_of(a), _rows_of(b), candidates - 0.5)
    pairs, height = a.shape[:2]

    def score_of(curve: Floats) -> Floats:
        return np.arctanh(np.clip(1 - curve, -_PERFECT, _PERFECT)) * root_columns

    curve = mirrored.mismatch()
    score = score_of(curve)
    optimum(candidates, score.max() - score)  # raises an error if the axis is at the edge
    best = int(score.argmax())
    around_best = slice(best - 1, best + 2)
    value = lowest(candidates[around_best], curve[around_best])[0]
    middle = pairs // 2 * height  # neighbouring projections are similar; projections 90° apart are not
    halves = [score_of(mirrored.mismatch(part)) for part in (slice(middle), slice(middle, None))]
    difference = max(abs(float(candidates[half.argmax()]) - value) for half in halves)
    pair_offsets = np.unique(np.linspace(1, pairs - 1, min(pairs - 1, _PAIRINGS)).astype(int))
    confident = difference < AGREE and all(
        score[best] > score_of(mirrored.mismatch(offset=int(n) * height)).max() for n in pair_offsets
    )
    return AxisEstimate(value, candidates, curve, confident, "opposite views")


def _opposites(projections: NDArray[np.floating], angles: Floats) -> tuple[Floats, Floats]:
    """Slopes along the columns [pair, row, col - 1] of some rows of projections, and the negated slopes of the opposite
    projections."""
    first, opposite = _opposite_pairs(np.asarray(angles, np.float64), projections.shape[2])
    if first.size < _FEWEST_PAIRS:
        raise ValueError(
            f"found {first.size} pairs of opposite projections (180° apart); at least {_FEWEST_PAIRS} are needed"
        )
    sampled = np.unique(np.linspace(0, first.size - 1, min(first.size, _MOST_PAIRS)).astype(int))
    first, opposite = first[sampled], opposite[sampled]
    data = few_rows(projections[np.concatenate((first, opposite))])
    if not np.isfinite(data).all():
        raise ValueError("the projections contain NaN or infinite values; correct them first")
    slopes = np.diff(uniform_filter1d(data, 3, axis=2), axis=2)
    slopes -= slopes.mean(axis=0)
    return slopes[: first.size], -slopes[first.size :]


def _opposite_pairs(angles: Floats, cols: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Projections of one half turn, and the projections that are opposite to them within 2 / cols radians."""
    theta = np.mod(angles, 2 * np.pi)
    distances = np.abs(np.mod(theta[:, None] - theta + np.pi, 2 * np.pi) - np.pi)
    opposite = distances.argmax(axis=1)
    exact = np.pi - distances[np.arange(theta.size), opposite] < max(2 / cols, 1e-9)
    first = np.flatnonzero(exact & (theta < theta[opposite]))
    first = first[np.argsort(theta[first], kind="stable")]
    return first, opposite[first]


def _rows_of(views: Floats) -> Floats:
    return views.reshape(-1, views.shape[2])


def mirror_mismatch(a: Floats, b: Floats, candidates: Floats) -> Floats:
    """1 - normalised correlation of a[i] with b[2 axis - i], over all rows and the columns that both have.

    The value is 1 if these columns contain too little of the variance, because columns of air always match.
    """
    return _Mirrored.of(a, b, candidates).mismatch()


@dataclass(frozen=True, eq=False)
class _Mirrored:
    """Rows [row, col] of two sets of projections, prepared for their correlation at each candidate.

    Attributes:
        total: i + j of the compared pixels. length: length of the transforms. count: number of columns that both have.
        spectra: spectra of both sets [row, frequency]; sums, variances: of both sets over these columns [row,
            candidate].
        powers: powers of both sets [row].
    """

    total: NDArray[np.int_]
    length: int
    count: NDArray[np.int_]
    spectra: tuple[NDArray[np.complex128], NDArray[np.complex128]]
    sums: tuple[Floats, Floats]
    variances: tuple[Floats, Floats]
    powers: tuple[Floats, Floats]

    @classmethod
    def of(cls, a: Floats, b: Floats, candidates: Floats) -> _Mirrored:
        rows, cols = a.shape
        sets = tuple(x - x.mean(axis=1, keepdims=True) for x in (a, b))
        total = (2 * candidates).astype(int)
        n = fft.next_fast_len(2 * cols, real=True)
        first, last = np.maximum(total - cols + 1, 0), np.minimum(total, cols - 1) + 1

        def sums(x: Floats) -> Floats:
            cumulative = np.concatenate([np.zeros((rows, 1)), np.cumsum(x, axis=1)], axis=1)
            return cumulative[:, last] - cumulative[:, first]

        column_sums = [sums(x) for x in sets]
        variances = [sums(x * x) - of_x**2 / (last - first) for x, of_x in zip(sets, column_sums, strict=True)]
        first_set, second_set = sets
        return cls(
            total, n, last - first, (fft.rfft(first_set, n), fft.rfft(second_set, n)), (column_sums[0], column_sums[1]),
            (variances[0], variances[1]), ((first_set * first_set).sum(axis=1), (second_set * second_set).sum(axis=1)),
        )  # fmt: skip

    def mismatch(self, rows: slice = _ALL, offset: int = 0) -> Floats:
        """Mismatch [candidate] of row i of the first set with row i - `offset` of the second set, for some rows i
        together."""
        (spectrum_a, spectrum_b), (sum_a, sum_b) = self.spectra, self.sums
        if offset:
            spectrum_b, sum_b = np.roll(spectrum_b, offset, axis=0), np.roll(sum_b, offset, axis=0)
        product = fft.irfft(np.einsum("rk,rk->k", spectrum_a[rows], spectrum_b[rows]), self.length)[self.total]
        covariance = product - np.einsum("rk,rk->k", sum_a[rows], sum_b[rows]) / self.count
        variance = self.variances[0][rows].sum(axis=0) * self.variances[1][rows].sum(axis=0)
        usable = variance > 1e-6 * self.powers[0][rows].sum() * self.powers[1][rows].sum()
        return np.where(usable, 1 - covariance / np.sqrt(np.where(usable, variance, 1)), 1)


def opposite_curves(data: Floats, theta: Floats) -> tuple[Floats, Floats]:
    """Candidates and their mismatch in the form of `wedge_curves`, computed from pairs of opposite projections.

    Raises:
        ValueError: see `axis_from_opposites`.
    """
    a, b = _opposites(data, theta)
    cols = data.shape[2]
    candidates = np.arange(2 * cols // _EDGE, 2 * (cols - 1) - 2 * cols // _EDGE) / 2
    rows = range(data.shape[1])
    return candidates, np.stack([mirror_mismatch(a[:, row], b[:, row], candidates - 0.5) for row in rows])


def find_axis(projections: ArrayLike, angles: ArrayLike) -> AxisEstimate:
    """The rotation axis (centre of rotation) of a scan, from all projections.

    First, `find_axis` uses all projections together. If all projections together show no axis and the scan covers 360°,
    `find_axis` uses pairs of opposite projections, because in half acquisition the axis is near an edge of the
    detector. In a 180° scan of a sample wider than the field of view, the two ends of the scan are used, or a pair of
    opposite projections.

    Args:
        projections: float32 [view, row, col], line integrals.
        angles: [view], radians.

    Returns:
        The estimate from all projections; if this estimate is not confident, a confident estimate from opposite
        projections, from the two ends of the scan, or from one pair of projections; if no estimate is confident, the
        estimate from all projections.

    Raises:
        ValueError: `axis_from_sinogram` cannot use the projections or the angles.
        AxisError: all projections together show no axis, and neither opposite projections nor the ends of the scan
            show one.

    Warns:
        UserWarning: angles look like degrees, or projections look like counts or transmission.
    """
    check_arguments(find_axis, locals())
    theta, projections = np.asarray(angles, np.float64), np.asarray(projections)
    if projections.ndim != 3:
        raise ValueError(f"projections must be [view, row, col], got shape {projections.shape}")
    warn_of_degrees(theta)
    warn_of_other_quantity(projections)
    try:
        from_all_views = axis_from_sinogram(projections, theta)
    except AxisError:
        if (from_pairs_or_ends := _from_pairs_or_ends(projections, theta)) is None:
            raise
        return from_pairs_or_ends
    return from_all_views if from_all_views.confident else _from_pairs_or_ends(projections, theta) or from_all_views


def _from_pairs_or_ends(projections: NDArray[np.floating], theta: Floats) -> AxisEstimate | None:
    """The axis from opposite projections if they show it clearly.

    Otherwise the estimate from the ends of the 180° scan (if the sample is wider than the field of view) or from a pair
    of projections, whichever is confident. If neither is, the estimate from the ends, or None.
    """
    by_ends = None
    with suppress(ValueError):  # AxisError is a ValueError
        if _opposite_pairs(theta, projections.shape[2])[0].size >= _FEWEST_PAIRS:
            by_opposites = axis_from_opposites(projections, theta)
            return by_opposites if by_opposites.confident else None
        if is_cut_off(projections):
            by_ends = axis_from_ends(projections, theta)
    with suppress(ValueError):
        pair = closest_pair(theta, tolerance=2 / projections.shape[2])
        if pair is not None and not (by_ends and by_ends.confident):
            by_pair = axis_from_pair(projections[pair[0]], projections[pair[1]])
            return by_pair if by_pair.confident else by_ends
    return by_ends


def closest_pair(theta: Floats, tolerance: float) -> tuple[int, int] | None:
    """The two projections that are nearest to 180° apart; None if no pair is within the tolerance (radians)."""
    order = np.argsort(np.mod(theta, 2 * np.pi))
    sorted_theta = np.mod(theta[order], 2 * np.pi)
    extended = np.concatenate([sorted_theta, sorted_theta + 2 * np.pi])
    index = np.searchsorted(extended, sorted_theta + np.pi)
    neighbours = np.stack([np.clip(index - 1, 0, None), np.clip(index, None, extended.size - 1)])
    deviations = np.abs(extended[neighbours] - sorted_theta - np.pi)
    neighbour, first = np.unravel_index(int(deviations.argmin()), deviations.shape)
    if deviations[neighbour, first] > tolerance:
        return None
    return int(order[first]), int(order[neighbours[neighbour, first] % order.size])
