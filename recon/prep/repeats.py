"""Repeats: measures how the sample changed, from two measurements of the same rays at different times. The beam may be
of any kind, and the sample of any width."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.ndimage import gaussian_filter

from recon.base.arrays import F32, F64, bin_views
from recon.base.geometry import Geometry
from recon.base.noise import NOISE_VIEWS, noise_level
from recon.base.views import spread

# approximate number of columns after binning; smallest number of rows, and of projections
_COLUMNS, _LEAST_ROWS, _LEAST_VIEWS = 64, 6, 12
_SMOOTH, _EDGE = 1.5, 2  # standard deviation of the smoothing, and width that is left out at each edge, in pixels
# limits for the distance in pixels between two rays at the edge of the field of view; beyond the second value the
# difference is not linear
_EXACT, _LINEAR = 0.1, 2.3
# the two projections of a pair must be at least one part in _LATER of the scan apart, and at least this share of the
# longest time in any pair
_LATER, _LONGEST = 3, 0.9
# largest number of projections for which pairs are searched; number of pairs; number of bands of rows, which are
# compared
_FIRSTS, _PAIRS, _BANDS = 512, 8, 4
# number of pixels with common errors: those that the Gaussian smoothing joins, twice
_CORRELATED = 2 * 4 * np.pi * _SMOOTH**2
_NOISY = 0.1  # ratio of noise to structure above which nothing is reported


def changes_seen(data: F32, geometry: Geometry) -> Iterator[tuple[tuple[int, int], float, F64, F64]]:
    """How the sample changes between projections of the same rays, which are 360° apart, or in a parallel beam 180°
    apart and mirrored.

    The effects of small changes are fitted to the difference of two projections: shifts, a small rotation, and changes
    of the absorption, of the air level and of the size along both directions. The sample may be wider than the field of
    view, because both projections see the same rays. The uncertainty comes from the disagreement between bands of rows
    and from the unexplained rest.

    Args:
        data: line integrals [view, row, col], in the order of time.

    Yields:
        The first pair of those examined; the mean time within a pair, as a share of the scan; the change in that time
        and its standard deviation, float64 [4] each. The four changes are the rows by which the sample sinks, and the
        shares by which three values grow: its line integrals, its size across the axis, and its size along the axis.
    """
    side = -(-data.shape[2] // _COLUMNS)
    if len(data) < _LEAST_VIEWS or data.shape[1] < _LEAST_ROWS * side:
        return
    noise = noise_level(bin_views(data[spread(np.arange(len(data)), NOISE_VIEWS)], side))
    for pairs in _pairs(geometry, data.shape[2] / side / 2):
        sums = [part for pair in pairs for part in _sums(data, geometry, pair, side)]
        normal, right, squares, structure, sizes = (np.stack(each) for each in zip(*sums, strict=True))
        total, of_all = normal.sum(axis=0), right.sum(axis=0)
        too_noisy = noise**2 / (2 * np.pi * _SMOOTH**2) * sizes.sum() > _NOISY**2 * structure.sum()
        # a single band of rows may contain all the information
        if too_noisy or np.linalg.matrix_rank(total - normal).min() < len(total):
            continue
        shares = np.linalg.solve(total, of_all)
        unexplained = max(float(squares.sum() - shares @ of_all), 0.0) / sizes.sum()
        without = np.linalg.solve(total - normal, (of_all - right)[..., None])[..., 0]
        alone = np.sqrt(np.diag(np.linalg.inv(total)) * unexplained * _CORRELATED)
        sigma, pixels = np.hypot(np.sqrt((len(sums) - 1) * without.var(axis=0)), alone), np.array([side, 1, 1, 1])
        apart = float(np.mean([later - first for first, later in pairs])) / (len(data) - 1)
        yield pairs[0], apart, shares[:4] * pixels, sigma[:4] * pixels


def _pairs(geometry: Geometry, reach: float) -> Iterator[list[tuple[int, int]]]:
    """Pairs (first, later) of projections of the same rays: exact pairs first, then nearly exact ones.

    Args:
        reach: columns from the axis to the edge.
    """
    angles, views, period = geometry.angles, np.arange(geometry.n_views), geometry.period
    firsts = spread(views, _FIRSTS)
    later, off = views - firsts[:, None], np.abs((angles - angles[firsts, None] + period / 2) % period - period / 2)
    for least in (_EXACT, _LINEAR):
        row, second = np.nonzero((later >= views.size // _LATER) & (off <= least / reach))
        if row.size:
            first, apart, between = firsts[row], off[row, second], later[row, second]
            longest = between >= _LONGEST * between.max()
            some = np.flatnonzero(longest & (apart <= apart[longest].min() + 1e-4))
            some = spread(some[np.argsort(second[some], kind="stable")], _PAIRS)
            yield list(zip(first[some].tolist(), second[some].tolist(), strict=True))


def _sums(
    data: F32, geometry: Geometry, pair: tuple[int, int], side: int
) -> Iterator[tuple[F64, F64, float, float, int]]:
    """Sums for each band of rows: normal equations of the changes, squares of difference and structure, pixels."""
    (first, later), axis = pair, (geometry.axis_col + 0.5) / side - 0.5
    second = min(later, len(data) - 2)
    beside = data[[first, later, second - 1, second, second + 1]]
    view, seen, before, near, after = (
        gaussian_filter(image.astype(np.float64), _SMOOTH, mode="nearest") for image in bin_views(beside, side)
    )
    cols = np.arange(view.shape[1], dtype=np.float64)
    known = (cols >= _EDGE) & (cols < cols.size - _EDGE)
    if round(float(geometry.angles[later] - geometry.angles[first]) / np.pi) % 2:
        across = 2 * axis - cols
        view = np.stack([np.interp(across, cols, row) for row in view])
        known &= (across >= 0) & (across <= cols.size - 1)
    mean, heights = (view + seen) / 2, np.arange(len(view))[:, None] - (len(view) - 1) / 2
    down, along = np.gradient(mean)
    turned = along, after - before, after - 2 * near + before, np.ones_like(mean)
    parts = [-down, mean, -(cols - axis) * along, -heights * down, *turned]
    for rows in np.array_split(np.arange(len(view)), _BANDS):
        shown, change = (
            np.stack([part[rows][:, known].ravel() for part in parts]),
            (seen - view)[rows][:, known].ravel(),
        )
        yield shown @ shown.T, shown @ change, change @ change, shown[1].var() * change.size, change.size
