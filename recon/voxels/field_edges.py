"""Field edges: the line integrals at the edges of the field of view, and the rows and columns that show material."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, F64
from recon.base.empirical import ENOUGH_MATTER
from recon.base.geometry import Geometry
from recon.base.reach import FieldEdges
from recon.base.view_data import Views
from recon.base.views import spread
from recon.base.volume import Grid
from recon.voxels.view_weights import covers_the_circle

_VIEWS, _ROWS, _PARTS = 32, 128, 4  # approximate numbers of projections and rows examined; parts of the scan
_FULL = 0.5  # share of the fullest row's mass that a row needs

CUT_SHARE, CUT_LEAST = 0.1, 0.02  # share of the value in the middle, and line integral; lower values at an edge are air
FARTHEST = 10.0  # largest distance of the end of a sample, in distances of the farther edge from the axis
_EDGE_COLUMNS = 3  # least number of columns whose mean is the level at an edge
# share of the distance to the farther edge that counts as outer columns; further in there may be a dense core
_OUTER = 0.25
# factor on the variance of independent columns; with 30, a can 3 times as wide as the field loses 0.4 dB
_VARIANCE_FACTOR = 80


def edge_levels(rows: F32) -> F32:
    """Line integrals [..., side] at the left and the right edge of rows [..., col]."""
    cols = rows.shape[-1]
    n = min(max(_EDGE_COLUMNS, cols // 100), cols)
    return np.stack([part.mean(axis=-1) for part in (rows[..., :n], rows[..., cols - n :])], axis=-1)


def ends_in_matter(mean: F32) -> NDArray[np.bool_]:
    """Whether rows [row, side] of the mean projection [row, col] end above a tenth of their middle, and above noise."""
    level = edge_levels(mean)
    return np.asarray((level > CUT_SHARE * mean.max(axis=-1)[:, None]) & (level > CUT_LEAST))


def sample_reach(mean: F32, axis: float) -> F64:
    """Distance [row] in columns from the axis to the end of the mean projection [row, col], if it falls as an ellipse.

    The square of an ellipse is a straight line over the squared distance from its middle. For a sample with a dense
    core, the outer columns show this line. For packed grains, all columns together show it better. So both slopes are
    averaged, weighted by the variance of the outer columns' slope and the squared difference of the slopes. From the
    edges alone (Hsieh et al. 2004, Med. Phys. 31, 2385), FBP of packed grains loses 0.4 dB if the can is twice as wide
    as the field of view (0.1 dB on two packings on which nothing was tuned).
    """
    squared_distance, squares = (np.arange(mean.shape[1]) - axis) ** 2, np.asarray(mean, np.float64) ** 2
    slopes = []
    for part in (squared_distance >= 0, outer := squared_distance >= (1 - _OUTER) ** 2 * squared_distance.max()):
        distance_deviations = squared_distance[part] - squared_distance[part].mean()
        slopes.append(
            -(squares[:, part] @ distance_deviations) / max(float(distance_deviations @ distance_deviations), 1e-30)
        )
    level = squares[:, outer].mean(axis=1)
    residual = squares[:, outer] - level[:, None] + slopes[1][:, None] * distance_deviations
    variance = (
        _VARIANCE_FACTOR * (residual**2).mean(axis=1) / max(float(distance_deviations @ distance_deviations), 1e-30)
    )
    difference = slopes[0] - slopes[1]
    slope = slopes[1] + difference * variance / (variance + difference**2 + 1e-30)
    return np.asarray(np.sqrt(squared_distance[outer].mean() + level / np.maximum(slope, 1e-30)))


def edges_of(views: Views) -> FieldEdges:
    """Edge levels of up to 32 projections, without laterally offset ones, in the rows that show material.

    Levels are medians over projections and rows, so that corners of a sample at some angles do not count. The smallest
    quarter of the scan counts, because a beam drifts away from its flats, but a sample is there from the first
    projection to the last. In a 360° scan with the axis off the middle, the edge near the axis is truncated on purpose,
    because the other half of the scan sees the missing part. So this edge is ignored. Values that are not finite, or
    have weight 0, do not count. An edge without any other value counts as air, because the box of voxels contains it.
    """
    centred_views = np.flatnonzero(views.geometry.is_centred)
    geometry, cols = views.geometry.select(centred_views), views.data.shape[2]
    width = max(2, cols // 50)
    if centred_views.size == 0 or cols < 2 * width:
        return FieldEdges({}, 0.0)
    numbers = spread(np.arange(centred_views.size), _VIEWS)
    part = np.ix_(centred_views[numbers], np.arange(0, views.data.shape[1], max(1, views.data.shape[1] // _ROWS)))
    sampled = views.data[part]
    known = np.isfinite(sampled) & (views.weights is None or views.weights[part] > 0)
    if not known.any():
        return FieldEdges({}, 0.0)
    sampled = np.where(known, sampled, np.nan)
    absorption = np.maximum(np.nan_to_num(sampled).mean(axis=(0, 2)), 0)
    sampled = sampled[:, absorption >= _FULL * absorption.max()]
    edges = {"left": sampled[..., :width], "right": sampled[..., -width:]}
    if geometry.is_off_middle and covers_the_circle(geometry.angles):
        far_side = "right" if geometry.axis_col < (cols - 1) / 2 else "left"
        edges = {far_side: edges[far_side]}
    levels = {
        side: min(_median(part) for part in np.array_split(values, min(_PARTS, len(values))))
        for side, values in edges.items()
    }
    of_views = {side: np.array([_median(view) for view in values]) for side, values in edges.items()}
    sampled = np.nan_to_num(sampled)
    is_truncated = ends_in_matter(sampled.mean(axis=0))[:, [int(side == "right") for side in edges]]
    return FieldEdges(levels, float(np.median(sampled.mean(axis=(1, 2)))), of_views, numbers, bool(is_truncated.any()))


def _median(values: F32) -> float:
    """Median over the measured rays; 0 if there are none."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else 0.0


AIR = 0.03
"""Share of the largest line integral; test reconstructions leave out columns below it.

Without it, the tests of a tooth take 129 CPU s instead of 55.
"""


BESIDE_MATTER = 0.05
"""Width of the air that test reconstructions keep on each side, as a share of the width of the material."""


def slab_of(geometry: Geometry, grid: Grid, first: int, stop: int) -> tuple[Geometry, Grid]:
    """The geometry of rows first..stop of a parallel beam, and the grid of the slices that they see, as wide as `grid`.

    If rows do not show slices, the grid contains all slices that any ray to these rows crosses.
    """
    views = geometry.rows(first, stop)
    slab = Grid.matching(views)
    if not geometry.rows_show_slices:
        low, high = views.heights
        slices = math.ceil((high - low + 2 * geometry.lean) / geometry.sample_pitch)
        slab = replace(slab, shape=(slices, *slab.shape[1:]), centre=((low + high) / 2, 0.0, 0.0))
    shape, centre = (slab.shape[0], *grid.shape[1:]), (slab.centre[0], *grid.centre[1:])
    return views, replace(grid, shape=shape, centre=centre, slice_pitch=slab.spacing[0])


def columns_of_matter(geometry: Geometry, grid: Grid, images: F32) -> tuple[slice, Geometry, Grid] | None:
    """The columns of `images` [view, row, col] that show material (and some air), their geometry, and their box.

    None if these are all columns, or if rows do not show slices around the detector's middle.
    """
    if not geometry.rows_show_slices or geometry.is_off_middle or any(grid.centre[1:]):
        return None
    deepest = images.mean(axis=1).max(axis=0)
    with_material = np.flatnonzero(deepest > AIR * deepest.max())
    axis, width = geometry.axis_col + geometry.shifts[:, 0], geometry.detector_shape[1]
    if not with_material.size:
        return None
    half_width = (1 + 2 * BESIDE_MATTER) * max(axis.max() - with_material[0], with_material[-1] - axis.min()) + 2
    first, stop = max(0, math.floor(axis.min() - half_width)), min(width, math.ceil(axis.max() + half_width) + 1)
    if stop - first == width:
        return None
    views = replace(
        geometry, detector_shape=(geometry.detector_shape[0], stop - first), axis_col=geometry.axis_col - first
    )
    width_in_voxels = 2 * half_width * geometry.sample_pitch / grid.voxel_size
    sides = (n - 2 * max(0, math.floor((n - width_in_voxels) / 2)) for n in grid.shape[1:])
    return slice(first, stop), views, replace(grid, shape=(grid.shape[0], *sides))


def middle_of_cone(geometry: Geometry, grid: Grid, data: F32, height: int) -> tuple[slice, Geometry, Grid] | None:
    """The middle `height` rows of a cone, their geometry, and the box that contains their rays.

    None if projections of a circular scan are displaced along the rows, or if these rows show little of the material in
    `data` [view, row, col].
    """
    row_offsets, is_circular = geometry.offsets[:, 1], not geometry.centres.any()
    first = round(geometry.axis_row + (0.0 if is_circular else float(np.median(row_offsets))) - (height - 1) / 2)
    rows = slice(first, first + height)
    if (is_circular and np.abs(row_offsets).max() > 1) or first < 0 or rows.stop > geometry.detector_shape[0]:
        return None
    sampled = data[:: max(1, len(data) // 8)]
    if np.abs(sampled[:, rows]).sum() < ENOUGH_MATTER * np.abs(sampled[:, busiest_rows(sampled, height)]).sum():
        return None
    # at the far side of the field of view
    climb = 0.0 if is_circular else float(np.ptp(row_offsets))
    box_height = (height + 1 + climb) * geometry.sample_pitch + 2 * geometry.lean
    box_height *= 1 + geometry.reach / geometry.source_distance
    slices = math.ceil(box_height / grid.spacing[0])
    box = replace(grid, shape=(slices, *grid.shape[1:]), centre=(0.0, *grid.centre[1:]))
    return rows, geometry.rows(rows.start, rows.stop), box


def busiest_rows(data: F32, height: int) -> slice:
    """The `height` adjacent rows with the most material in line integrals [view, row, col]."""
    rows = data.shape[1]
    if rows <= height:
        return slice(0, rows)
    sampled = data[:: max(1, len(data) // 8)]
    cumulative = np.concatenate(([0.0], np.cumsum(np.abs(sampled).sum(axis=(0, 2), dtype=np.float64))))
    first = int(np.argmax(cumulative[height:] - cumulative[:-height]))
    return slice(first, first + height)
