"""Repeats: views of the same rays at two times show how the sample changed, also in a cone and beyond the field."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.ndimage import gaussian_filter

from recon.base.arrays import F32, F64, bin_views
from recon.base.geometry import Geometry
from recon.base.noise import NOISE_VIEWS, noise_level
from recon.base.views import spread

_COLUMNS, _LEAST_ROWS, _LEAST_VIEWS = 64, 6, 12  # columns after binning, about; fewer rows or views tell nothing
_SMOOTH, _EDGE = 1.5, 2  # pixels: standard deviation of the smoothing, and those left out at either edge
_EXACT, _LINEAR = 0.1, 2.3  # pixels between two rays at the edge of the field: beyond, the difference is not linear
_LATER, _LONGEST = 3, 0.9  # a pair lies a third of the scan apart at least; share of the longest time between two
_FIRSTS, _PAIRS, _BANDS = 512, 8, 4  # views whose pairs are sought, at most; pairs; bands of rows, which may disagree
_CORRELATED = 2 * 4 * np.pi * _SMOOTH**2  # pixels whose errors are one: those that the Gaussian joins, twice
_NOISY = 0.1  # noise over the structure of the views, beyond which nothing is reported


def changes_seen(data: F32, geometry: Geometry) -> Iterator[tuple[tuple[int, int], float, F64, F64]]:
    """How the sample changes between views of the same rays: half a turn apart, mirrored (parallel), or a turn.

    The difference of two views is fitted by what small changes do to them: shifts, a small turn, more or less
    absorption, a change of the air, and of both sizes. Whatever the sample is beyond the field, the same rays meet it.
    How bands of rows disagree is uncertainty, and so is what stays unexplained.

    Args:
        data: line integrals [view, row, col], in the order of time.

    Yields:
        The first of the pairs of views that are looked at, the mean time between the views of a pair as a share of the
        scan, and the change in that time with its standard deviation, float64 [4] each: rows by which the sample sinks,
        and shares by which its line integrals, its size across the axis and its size along the axis grow.
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
        if too_noisy or np.linalg.matrix_rank(total - normal).min() < len(total):  # a band may hold all there is
            continue
        shares = np.linalg.solve(total, of_all)
        unexplained = max(float(squares.sum() - shares @ of_all), 0.0) / sizes.sum()
        without = np.linalg.solve(total - normal, (of_all - right)[..., None])[..., 0]
        alone = np.sqrt(np.diag(np.linalg.inv(total)) * unexplained * _CORRELATED)
        sigma, pixels = np.hypot(np.sqrt((len(sums) - 1) * without.var(axis=0)), alone), np.array([side, 1, 1, 1])
        apart = float(np.mean([later - first for first, later in pairs])) / (len(data) - 1)
        yield pairs[0], apart, shares[:4] * pixels, sigma[:4] * pixels


def _pairs(geometry: Geometry, reach: float) -> Iterator[list[tuple[int, int]]]:
    """Pairs of views of the same rays, the first and the later: those that are exact, then those nearly so.

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
    """Sums for each band of rows: normal equations of the changes; squares of difference and structure; pixels."""
    (first, later), axis = pair, (geometry.axis_col + 0.5) / side - 0.5
    at = min(later, len(data) - 2)
    beside = data[[first, later, at - 1, at, at + 1]]
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
