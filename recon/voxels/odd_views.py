"""odd_views: finds projections in which a part differs from the volume more than in the neighbouring projections."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter, label, uniform_filter

from recon.base.arrays import F32, I64, bin_views
from recon.base.geometry import Geometry
from recon.base.noise import deviation_between_neighbours
from recon.base.view_data import Views
from recon.base.volume import Grid
from recon.voxels.one_projection import BAND, AskedRays, RayCheck, in_bands
from recon.voxels.projector import projection_images

LIMIT = 12.0
"""Limit of the score, in standard deviations of the usual differences. Clean real scans stay below 9.4."""

_CELLS = 128  # fewest columns of cells, if the detector has that many pixels
_BLUR = 4  # pixels; range of a blur by one pixel
# number of rows of cells that are compared together; number of projections that are compared together
_BAND, _TOGETHER = 16, 32
_AT_A_TIME = 8  # number of projections of a cone beam that are computed together
_CELLS_AVERAGED = 3  # side of the area, in cells, over which a difference is averaged
# number of projections on either side that define the usual difference; number of nearest projections that are left out
_VIEWS_AROUND, _VIEWS_BESIDE = 12, 3
# least noise of a pixel as a share of the largest line integral; frames, and residuals of fits, have at least this
# noise
_LEAST_NOISE = 2e-3
_OUTLIER = 3.0  # largest contribution of one projection, in units of the median over all projections
_SHARP = 0.1  # a volume may miss an edge by this share of the change that a blur of one pixel causes
_EXTENT = 0.5  # a cell belongs to the region if its score exceeds this share of the limit
_LEAST_VIEWS = 2 * _VIEWS_AROUND + 1


@dataclass(frozen=True)
class OddView:
    """A part of a projection that differs from the volume.

    Attributes:
        view: index in the projections.
        score: difference in standard deviations; above 0 if the projection shows more absorption than the volume.
        rows, cols: rows and columns of the part: the first one, and the one after the last.
    """

    view: int
    score: float
    rows: tuple[int, int]
    cols: tuple[int, int]


def odd_views(grid: Grid, views: Views) -> RayCheck[tuple[OddView, ...]]:
    """Projections in which something crossed the beam or the sample was displaced, found in the differences p - A x.

    The check takes the difference of each projection from that of the volume, minus the common change of its pixels
    (light). It averages the difference over 3 x 3 cells, in standard deviations of the projection's noise and finest
    detail. No volume fits its projections perfectly at edges that it blurs, at rings, or outside the field of view. So
    a difference is compared with the same place in the 18 projections at the nearest angles. It is also compared with
    the edges of the volume in the projection itself, because a face or a crack that is parallel to the rays is sharp
    only in a few projections (our own method).

    Returns:
        The check. Its result is the parts in the order of the projections; empty for fewer than 25 projections.
    """
    geometry, side = views.geometry, _side(views.geometry)
    all_views, rows = np.arange(geometry.n_views), geometry.detector_shape[0]
    if all_views.size < _LEAST_VIEWS:
        return RayCheck((), lambda: ())
    cells = _Cells(*(np.zeros((all_views.size, rows // side, geometry.detector_shape[1] // side), np.float32)
                     for _ in range(6)))  # fmt: skip
    if in_bands(geometry, grid):
        band, end = _band(geometry), rows - rows % side  # rows at the end that do not fill a cell do not count
        own_rows = [slice(first, min(first + band, end)) for first in range(0, end, band)]
        regions = [
            (all_views, part, slice(max(part.start - _BLUR, 0), min(part.stop + _BLUR, rows))) for part in own_rows
        ]
    else:
        groups = (all_views[first : first + _AT_A_TIME] for first in range(0, all_views.size, _AT_A_TIME))
        regions = [(group, slice(0, rows), slice(0, rows)) for group in groups]
    parts = [
        AskedRays(group, projected_rows, partial(_fill, cells, views, group, own_rows, projected_rows))
        for group, own_rows, projected_rows in regions
    ]
    return RayCheck(parts, lambda: _found_odd_views(*_differences(cells, side), geometry, side))


def _found_odd_views(differences: F32, edges: F32, geometry: Geometry, side: int) -> tuple[OddView, ...]:
    """The odd projections, found in the `_differences` of all projections."""
    n, order, odd_views = geometry.n_views, np.argsort(geometry.angles, kind="stable"), []
    for position in range(n):
        first = min(max(position - _VIEWS_AROUND, 0), n - _LEAST_VIEWS)
        neighbours = [k for k in range(first, first + _LEAST_VIEWS) if abs(k - position) > _VIEWS_BESIDE]
        neighbour_squares = differences[order[neighbours]] ** 2
        usual_squares = np.minimum(neighbour_squares, _OUTLIER**2 * (1 + np.median(neighbour_squares, axis=0))).mean(
            axis=0
        )
        score = differences[order[position]] / np.sqrt(
            np.maximum(uniform_filter(usual_squares, _CELLS_AVERAGED) + edges[order[position]] ** 2, 1)
        )
        worst = np.unravel_index(np.abs(score).argmax(), score.shape)
        peak = float(score[worst])
        if abs(peak) > LIMIT:
            parts, _ = label(score * math.copysign(1, peak) > _EXTENT * LIMIT)
            region = np.nonzero(parts == parts[worst])
            spans = [(int(cells.min()) * side, (int(cells.max()) + 1) * side) for cells in region]
            odd_views.append(OddView(int(order[position]), peak, spans[0], spans[1]))
    return tuple(sorted(odd_views, key=lambda odd_view: odd_view.view))


def odd_views_memory(geometry: Geometry) -> int:
    """Approximate memory of `odd_views` in bytes, without projections and volume."""
    views, (rows, cols), grid = geometry.n_views, geometry.detector_shape, Grid.matching(geometry)
    side, (_, height, width) = _side(geometry), grid.shape
    cells = (rows // side) * (cols // side)
    if in_bands(geometry, grid):
        band = min(BAND, rows)
        band_rows = min(_band(geometry), rows)
        projected_rows = min(band_rows + 2 * _BLUR, rows)
        # two bands wait for rows that both need; the slices of a band, and the coefficients and lines of its rays
        waiting = views * cols * (2 * projected_rows * (band_rows < rows) + band)
        lines = waiting + band * height * width + views * cols * max(40, 2 * band + 16)
        lines = max(lines, waiting + 10 * min(_TOGETHER, views) * projected_rows * cols)
    else:  # the whole volume as lines, and some projections
        lines = math.prod(grid.shape) + 14 * min(_AT_A_TIME, views) * rows * cols
    return 4 * (max(lines, 6 * _VIEWS_AROUND * cells) + 6 * views * cells)


def _side(geometry: Geometry) -> int:
    rows, cols = geometry.detector_shape
    return max(1, min(cols // _CELLS, rows))


def _band(geometry: Geometry) -> int:
    """Number of rows that are projected together; a whole number of cells."""
    return _side(geometry) * max(1, _BAND // _side(geometry))


def _finest_detail(models: F32) -> F32:
    """Projections [view, row, col] minus the same projections blurred by a pixel."""
    return np.abs(models - gaussian_filter(models, (0, 1, 1), truncate=_BLUR))


class _Cells(NamedTuple):
    """Means over cells [view, cell, cell]. Pixels are weighted with the square root of the intensity; unknown pixels
    have the weight 0. The means are: the difference of the projections from the volume, the part of the difference that
    edges explain, the known pixels, the projection, the weight, and the difference without weight.
    """

    difference: F32
    edges: F32
    known: F32
    projection: F32
    weight: F32
    plain_difference: F32


def _fill(cells: _Cells, whole: Views, group: I64, own_rows: slice, projected_rows: slice, lines: F32) -> None:
    """Compute the cells of some projections in the rows `own_rows`, from the projection of the volume in these and the
    neighbouring rows (`projected_rows`).
    """
    side = _side(whole.geometry)
    rows = slice(own_rows.start - projected_rows.start, own_rows.stop - projected_rows.start)
    for first in range(0, group.size, _TOGETHER):
        views = slice(int(group[0]) + first, int(group[0]) + min(first + _TOGETHER, group.size))
        images = projection_images(lines[first : first + _TOGETHER])
        model, measured = images[:, rows], whole.data[views, own_rows]
        difference = measured - model
        known = (
            np.ones_like(model) if whole.weights is None else (whole.weights[views, own_rows] > 0).astype(np.float32)
        )
        weight = np.sqrt(np.exp(-np.clip(measured, 0, 20))) * known
        values = (
            difference * weight,
            _finest_detail(images)[:, rows] * weight,
            known,
            measured * weight,
            weight,
            difference * known,
        )
        for cell, value in zip(cells, values, strict=True):
            cell[views, own_rows.start // side : own_rows.stop // side] = bin_views(value, side)


def _differences(cells: _Cells, side: int) -> tuple[F32, F32]:
    """The difference of the projections from the volume, and the part of it that edges explain.

    Both are [view, cell, cell], averaged over cells, in standard deviations of the noise.
    """
    for cell, edge, known, projection, weight, unweighted in zip(*cells, strict=True):
        # the finest detail of the sample counts as noise
        noise = max(deviation_between_neighbours(projection, 3), _LEAST_NOISE / side * float(np.abs(projection).max()))
        if not known.any() or not noise > 0:
            cell[...], edge[...] = 0, 0
            continue
        cell -= np.float32(np.median(unweighted[known > 0])) * weight
        # Sums over cells with known pixels, divided by their noise. There are fewer cells at an edge, and with a single
        # row.
        known_share = uniform_filter(known, _CELLS_AVERAGED, mode="constant")
        scale = np.divide(
            _CELLS_AVERAGED / noise, np.sqrt(known_share), out=np.zeros_like(known_share), where=known_share > 0
        )
        cell[...] = uniform_filter(cell, _CELLS_AVERAGED, mode="constant") * scale
        edge[...] = uniform_filter(_SHARP * edge, _CELLS_AVERAGED, mode="constant") * scale
    return cells.difference, cells.edges
