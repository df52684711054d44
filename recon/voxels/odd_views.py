"""odd_views: views of which a part is not what a volume made of them has there, against the views beside them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, label, uniform_filter

from recon.base.geometry import Geometry
from recon.base.noise import median_deviation
from recon.base.volume import Volume
from recon.voxels.projector import project

F32 = NDArray[np.float32]

LIMIT = 12.0
"""Standard deviations of what is usual at a place: three clean real scans stay below 9.4 (docs/exploration.md)."""

_CELLS = 128  # columns of cells, at least, where the detector has so many pixels
_BROAD = 3  # cells a side, over which a difference is averaged
_AROUND, _BESIDE = 12, 3  # views on either side that say what is usual, without so many next to the one that is judged
_OUTLIER = 3.0  # times the median of these, which one of them may add
_SHARP = 0.1  # of what a blur of one pixel changes in a view, by which any volume may miss an edge
_EXTENT = 0.5  # of the limit, above which a cell belongs to the region
_LEAST_VIEWS = 2 * _AROUND + 1


@dataclass(frozen=True)
class OddView:
    """A view that differs from the volume in a part.

    Attributes:
        view: index in the projections.
        score: difference in standard deviations; above 0 where the view absorbs more than the volume.
        rows, cols: pixels of the projections, first and one after the last.
    """

    view: int
    score: float
    rows: tuple[int, int]
    cols: tuple[int, int]


def odd_views(
    volume: Volume, projections: F32, geometry: Geometry, weights: F32 | None = None, limit: float = LIMIT
) -> tuple[OddView, ...]:
    """Views in which something was in the beam, or the sample was elsewhere, for few views: p - A x, seen by place.

    The difference of each view from the volume's projection, less what all its pixels have in common (light), averaged
    over 3 x 3 cells, in standard deviations of the view's noise and finest detail. No volume fits its views fully: at
    edges that it blurs, at rings, at what lies outside the field. So a difference counts by what the 18 views of the
    nearest angles have at the same place, and by the edges of the volume in the view itself, where a face or a crack
    that is parallel to the rays is sharp in few views only [our own].

    Args:
        projections: [view, row, col].
        weights: of the rays [view, row, col]; those of weight 0 were not measured.
        limit: score from which a view is odd.

    Returns:
        In the order of the views; none of fewer than 25 views.
    """
    n = geometry.n_views
    if n < _LEAST_VIEWS:
        return ()
    order = np.argsort(geometry.angles, kind="stable")
    rows, cols = geometry.detector_shape
    side = max(1, min(cols // _CELLS, rows))
    looks = (_difference(volume, projections, geometry, weights, int(i), side) for i in order)
    differences, edges = (np.stack(each) for each in zip(*looks, strict=True))
    squares = differences**2
    found = []
    for place in range(n):
        first = min(max(place - _AROUND, 0), n - _LEAST_VIEWS)
        near = [k for k in range(first, first + _LEAST_VIEWS) if abs(k - place) > _BESIDE]
        around = squares[near]
        usual = np.minimum(around, _OUTLIER**2 * (1 + np.median(around, axis=0))).mean(axis=0)
        score = differences[place] / np.sqrt(np.maximum(uniform_filter(usual, _BROAD) + edges[place] ** 2, 1))
        worst = np.unravel_index(np.abs(score).argmax(), score.shape)
        peak = float(score[worst])
        if abs(peak) > limit:
            parts, _ = label(score * math.copysign(1, peak) > _EXTENT * limit)
            there = np.nonzero(parts == parts[worst])
            spans = [(int(cells.min()) * side, (int(cells.max()) + 1) * side) for cells in there]
            found.append(OddView(int(order[place]), peak, spans[0], spans[1]))
    return tuple(sorted(found, key=lambda odd: odd.view))


def _difference(
    volume: Volume, projections: F32, geometry: Geometry, weights: F32 | None, view: int, side: int
) -> tuple[F32, F32]:
    """Of one view from the volume, averaged over cells, in standard deviations of noise; what edges explain of it."""
    measured = projections[view]
    rendered = project(volume, geometry.select(np.array([view])))[0]
    left = measured - rendered
    known = np.ones_like(left) if weights is None else (weights[view] > 0).astype(np.float32)
    light = np.sqrt(np.exp(-np.clip(measured, 0, 20))) * known
    cells, lit = _cells(left * light, side), _cells(known, side)
    third = np.diff(_cells(measured * light, side), 3, axis=1)  # of the view: what is finest in the sample counts too
    noise = median_deviation(third) / math.sqrt(20.0)
    if not lit.any() or not noise > 0:
        return np.zeros_like(cells), np.zeros_like(cells)
    common = float(np.median(_cells(left * known, side)[lit > 0]))
    cells -= np.float32(common) * _cells(light, side)
    sharp = _cells(np.abs(rendered - gaussian_filter(rendered, 1.0)) * light, side)
    # Sums over the cells that are there and lit, by their own noise: there are fewer at an edge, and of a single row.
    there = uniform_filter(lit, _BROAD, mode="constant")
    scale = np.divide(_BROAD / noise, np.sqrt(there), out=np.zeros_like(there), where=there > 0)
    difference, edges = (uniform_filter(each, _BROAD, mode="constant") * scale for each in (cells, _SHARP * sharp))
    return difference.astype(np.float32), edges.astype(np.float32)


def _cells(image: F32, side: int) -> F32:
    """Means of squares of pixels; rows and columns left over at the ends count for nothing."""
    rows, cols = (n // side for n in image.shape)
    whole = image[: rows * side, : cols * side]
    return np.asarray(whole.reshape(rows, side, cols, side).mean(axis=(1, 3)), np.float32)
