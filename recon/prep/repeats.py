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
        normal, right_sides, squares, structure, sizes = (np.stack(each) for each in zip(*sums, strict=True))
        total_normal, total_right = normal.sum(axis=0), right_sides.sum(axis=0)
        too_noisy = noise**2 / (2 * np.pi * _SMOOTH**2) * sizes.sum() > _NOISY**2 * structure.sum()
        # a single band of rows may contain all the information
        if too_noisy or np.linalg.matrix_rank(total_normal - normal).min() < len(total_normal):
            continue
        changes = np.linalg.solve(total_normal, total_right)
        unexplained = max(float(squares.sum() - changes @ total_right), 0.0) / sizes.sum()
        without = np.linalg.solve(total_normal - normal, (total_right - right_sides)[..., None])[..., 0]
        sigma_of_residual = np.sqrt(np.diag(np.linalg.inv(total_normal)) * unexplained * _CORRELATED)
        sigma, pixels = (
            np.hypot(np.sqrt((len(sums) - 1) * without.var(axis=0)), sigma_of_residual),
            np.array([side, 1, 1, 1]),
        )
        time_between = float(np.mean([later - first for first, later in pairs])) / (len(data) - 1)
        yield pairs[0], time_between, changes[:4] * pixels, sigma[:4] * pixels


def _pairs(geometry: Geometry, reach: float) -> Iterator[list[tuple[int, int]]]:
    """Pairs (first, later) of projections of the same rays: exact pairs first, then nearly exact ones.

    Args:
        reach: columns from the axis to the edge.
    """
    angles, views, period = geometry.angles, np.arange(geometry.n_views), geometry.period
    firsts = spread(views, _FIRSTS)
    later, angle_errors = (
        views - firsts[:, None],
        np.abs((angles - angles[firsts, None] + period / 2) % period - period / 2),
    )
    for limit in (_EXACT, _LINEAR):
        row, second = np.nonzero((later >= views.size // _LATER) & (angle_errors <= limit / reach))
        if row.size:
            first, angle_error, time_between = firsts[row], angle_errors[row, second], later[row, second]
            longest = time_between >= _LONGEST * time_between.max()
            chosen = np.flatnonzero(longest & (angle_error <= angle_error[longest].min() + 1e-4))
            chosen = spread(chosen[np.argsort(second[chosen], kind="stable")], _PAIRS)
            yield list(zip(first[chosen].tolist(), second[chosen].tolist(), strict=True))


def _sums(
    data: F32, geometry: Geometry, pair: tuple[int, int], side: int
) -> Iterator[tuple[F64, F64, float, float, int]]:
    """Sums for each band of rows: normal equations of the changes, squares of difference and structure, pixels."""
    (first, later), axis = pair, (geometry.axis_col + 0.5) / side - 0.5
    second = min(later, len(data) - 2)
    images = data[[first, later, second - 1, second, second + 1]]
    first_image, later_image, previous, middle, following = (
        gaussian_filter(image.astype(np.float64), _SMOOTH, mode="nearest") for image in bin_views(images, side)
    )
    cols = np.arange(first_image.shape[1], dtype=np.float64)
    seen_in_both = (cols >= _EDGE) & (cols < cols.size - _EDGE)
    if round(float(geometry.angles[later] - geometry.angles[first]) / np.pi) % 2:
        mirrored_cols = 2 * axis - cols
        first_image = np.stack([np.interp(mirrored_cols, cols, row) for row in first_image])
        seen_in_both &= (mirrored_cols >= 0) & (mirrored_cols <= cols.size - 1)
    mean, heights = (first_image + later_image) / 2, np.arange(len(first_image))[:, None] - (len(first_image) - 1) / 2
    row_gradient, col_gradient = np.gradient(mean)
    other_effects = col_gradient, following - previous, following - 2 * middle + previous, np.ones_like(mean)
    effect_images = [-row_gradient, mean, -(cols - axis) * col_gradient, -heights * row_gradient, *other_effects]
    for rows in np.array_split(np.arange(len(first_image)), _BANDS):
        effects, change = (
            np.stack([part[rows][:, seen_in_both].ravel() for part in effect_images]),
            (later_image - first_image)[rows][:, seen_in_both].ravel(),
        )
        yield effects @ effects.T, effects @ change, change @ change, effects[1].var() * change.size, change.size
