"""odd_views: finds projections in which a part differs from the volume more than in the neighbouring projections."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, label, uniform_filter

from recon.base.arrays import F32, bin_views
from recon.base.geometry import Geometry
from recon.base.noise import deviation_between_neighbours
from recon.base.slabs import part_of
from recon.base.view_data import Views
from recon.base.volume import Grid, Volume
from recon.voxels.projector import Projector, project, projection_images, volume_lines

LIMIT = 12.0
"""Limit of the score, in standard deviations of the usual differences. Clean real scans stay below 9.4."""

_CELLS = 128  # fewest columns of cells, if the detector has that many pixels
_BLUR = 4  # pixels; range of a blur by one pixel
# number of rows that are projected together; number of projections that are compared together
_BAND, _TOGETHER = 16, 32
_AT_A_TIME = 8  # number of projections of a cone beam that are computed together
_BROAD = 3  # side of the area, in cells, over which a difference is averaged
# number of projections on either side that define the usual difference; number of nearest projections that are left out
_AROUND, _BESIDE = 12, 3
# least noise of a pixel as a share of the largest line integral; frames, and residuals of fits, have at least this
# noise
_LEAST_NOISE = 2e-3
_OUTLIER = 3.0  # largest contribution of one projection, in units of the median over all projections
_SHARP = 0.1  # a volume may miss an edge by this share of the change that a blur of one pixel causes
_EXTENT = 0.5  # a cell belongs to the region if its score exceeds this share of the limit
_LEAST_VIEWS = 2 * _AROUND + 1


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


def odd_views(
    volume: Volume, views: Views, progress: Callable[[int, int], None] = lambda done, of: None
) -> tuple[OddView, ...]:
    """Find projections in which something crossed the beam or the sample was displaced, from the differences p - A x.

    The check takes the difference of each projection from that of the volume, minus the common change of its pixels
    (light). It averages the difference over 3 x 3 cells, in standard deviations of the projection's noise and finest
    detail. No volume fits its projections perfectly at edges that it blurs, at rings, or outside the field of view. So
    a difference is compared with the same place in the 18 projections at the nearest angles. It is also compared with
    the edges of the volume in the projection itself, because a face or a crack that is parallel to the rays is sharp
    only in a few projections (our own method).

    Args:
        progress: function called with the number of projections compared so far, and their total number. If bands of
            rows are compared one after the other, each band counts with its share.

    Returns:
        The parts in the order of the projections; empty for fewer than 25 projections.
    """
    n, side = views.geometry.n_views, _side(views.geometry)
    if n < _LEAST_VIEWS:
        return ()
    order = np.argsort(views.geometry.angles, kind="stable")
    differences, edges = (each[order] for each in _differences(volume, views, side, progress))
    found = []
    for place in range(n):
        first = min(max(place - _AROUND, 0), n - _LEAST_VIEWS)
        neighbours = [k for k in range(first, first + _LEAST_VIEWS) if abs(k - place) > _BESIDE]
        around = differences[neighbours] ** 2
        usual = np.minimum(around, _OUTLIER**2 * (1 + np.median(around, axis=0))).mean(axis=0)
        score = differences[place] / np.sqrt(np.maximum(uniform_filter(usual, _BROAD) + edges[place] ** 2, 1))
        worst = np.unravel_index(np.abs(score).argmax(), score.shape)
        peak = float(score[worst])
        if abs(peak) > LIMIT:
            parts, _ = label(score * math.copysign(1, peak) > _EXTENT * LIMIT)
            region = np.nonzero(parts == parts[worst])
            spans = [(int(cells.min()) * side, (int(cells.max()) + 1) * side) for cells in region]
            found.append(OddView(int(order[place]), peak, spans[0], spans[1]))
    return tuple(sorted(found, key=lambda odd: odd.view))


def odd_views_memory(geometry: Geometry) -> int:
    """Approximate memory of `odd_views` in bytes, without projections and volume."""
    views, (rows, cols) = geometry.n_views, geometry.detector_shape
    side, height = _side(geometry), min(_band(geometry), rows)
    band = (height + 2 * _BLUR) * cols * (cols + 2 * views + 8 * _TOGETHER)
    return 4 * (band + 7 * views * (rows // side) * (cols // side))


def _side(geometry: Geometry) -> int:
    rows, cols = geometry.detector_shape
    return max(1, min(cols // _CELLS, rows))


def _band(geometry: Geometry) -> int:
    """Number of rows that are projected together; a whole number of cells."""
    return _side(geometry) * max(1, _BAND // _side(geometry))


def _projected(volume: Volume, geometry: Geometry) -> Iterator[tuple[slice, slice, F32, F32]]:
    """Yields projections, rows, the volume's projection [view, row, col] and its sharp part.

    In bands of rows if rows show slices.
    """
    rows, band = geometry.detector_shape[0], _band(geometry)
    if not geometry.rows_show_slices or volume.grid != Grid.matching(geometry):
        # computed only once, because for a large volume it takes as long as a projection
        lines = volume_lines(volume.data)
        for view in range(0, geometry.n_views, _AT_A_TIME):
            some = slice(view, view + _AT_A_TIME)
            model = projection_images(Projector(geometry.select(some), volume.grid).forward_lines(lines))
            yield some, slice(0, rows), model, _sharp(model)
        return
    whole = rows - rows % _side(geometry)  # rows at the end that do not fill a cell are left out
    for first in range(0, whole, band):
        part = slice(first, min(first + band, whole))
        around = slice(max(first - _BLUR, 0), min(part.stop + _BLUR, rows))
        _, views, grid = part_of(geometry, volume.grid, around)
        every = project(Volume(volume.data[around], grid), views)
        own = slice(first - around.start, part.stop - around.start)
        for view in range(0, geometry.n_views, _TOGETHER):
            models = every[view : view + _TOGETHER]
            yield slice(view, view + _TOGETHER), part, models[:, own], _sharp(models)[:, own]


def _sharp(models: F32) -> F32:
    """Projections [view, row, col] minus the same projections blurred by a pixel."""
    return np.abs(models - gaussian_filter(models, (0, 1, 1), truncate=_BLUR))


def _differences(volume: Volume, whole: Views, side: int, progress: Callable[[int, int], None]) -> tuple[F32, F32]:
    """The difference of the projections from the volume, and the part of it that edges explain.

    Both are [view, cell, cell], averaged over cells, in standard deviations of the noise.
    """
    geometry, weights = whole.geometry, whole.weights
    rows, cols = (n // side for n in geometry.detector_shape)
    # `weight` is the square root of the intensity, 0 in unknown pixels. Means over cells are computed of the weighted
    # difference, its part that edges explain, the known pixels, the weighted projection, the weight, and the difference
    # without weight.
    cells, edges, known_cells, weighted_cells, weight_cells, mean_difference = (
        np.zeros((geometry.n_views, rows, cols), np.float32) for _ in range(6)
    )
    compared = 0
    for views, part, model, sharp in _projected(volume, geometry):
        measured = whole.data[views, part]
        difference = measured - model
        known = np.ones_like(model) if weights is None else (weights[views, part] > 0).astype(np.float32)
        weight = np.sqrt(np.exp(-np.clip(measured, 0, 20))) * known
        block = views, slice(part.start // side, part.stop // side)
        cells[block], known_cells[block] = bin_views(difference * weight, side), bin_views(known, side)
        weighted_cells[block], weight_cells[block] = bin_views(measured * weight, side), bin_views(weight, side)
        mean_difference[block] = bin_views(difference * known, side)
        edges[block] = bin_views(sharp * weight, side)
        compared += len(model) * model.shape[1]
        progress(min(compared // (rows * side), geometry.n_views), geometry.n_views)
    for view, (cell, edge) in enumerate(zip(cells, edges, strict=True)):
        # the finest detail of the sample counts as noise
        detail = deviation_between_neighbours(weighted_cells[view], 3)
        noise = max(detail, _LEAST_NOISE / side * float(np.abs(weighted_cells[view]).max()))
        if not known_cells[view].any() or not noise > 0:
            cell[...], edge[...] = 0, 0
            continue
        cell -= np.float32(np.median(mean_difference[view][known_cells[view] > 0])) * weight_cells[view]
        # Sums over cells with known pixels, divided by their noise. There are fewer cells at an edge, and with a single
        # row.
        known_share = uniform_filter(known_cells[view], _BROAD, mode="constant")
        scale = np.divide(_BROAD / noise, np.sqrt(known_share), out=np.zeros_like(known_share), where=known_share > 0)
        cell[...] = uniform_filter(cell, _BROAD, mode="constant") * scale
        edge[...] = uniform_filter(_SHARP * edge, _BROAD, mode="constant") * scale
    return cells, edges
