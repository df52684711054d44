"""Residuals: what a volume leaves of views, view by view, at the resolution of its voxels."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from recon.base.arrays import F32, F64, I64, Mask
from recon.base.slabs import part_of
from recon.base.view_data import Views
from recon.base.views import spread
from recon.base.volume import Grid, Volume
from recon.voxels.projector import Projector, projection_lines, volume_lines
from recon.voxels.resolution import ViewResolution, at_voxel_resolution
from recon.voxels.voxel_problem import whitened

RAYS, _ROWS = 2**17, 16  # of a view; rows of a band: bands of rows stand for a large detector
_GROUPS = 4  # of views that are projected one after the other, where rows show no slices


class SquaresLeft(NamedTuple):
    """Sums over the measured rays of each view [view]: squares of what a volume leaves, squares of the view itself, and
    the number of these rays."""

    left: F64
    own: F64
    rays: F64

    @property
    def residual(self) -> float:
        """The data residual of all these views, for every command that states one.

        Raises:
            ValueError: the views are zero everywhere.
        """
        if not self.own.any():
            raise ValueError("all projections are zero, so no residual can be computed")
        return math.sqrt(self.left.sum() / self.own.sum())


def squares_left(model: F32, views: F32, weight: F32 | None, resolution: ViewResolution) -> SquaresLeft:
    """What a volume leaves of each view, at the resolution of voxels.

    The truth leaves the noise alone, by that; of views as measured it would leave more than a sharper volume does.

    Args:
        model: [view, col, row], the projection of the volume by a `Projector` of this resolution.
        views: line integrals as measured, less what no voxel can explain. Values that are not finite do not count.
        weight: of the rays; None: one for all.
    """
    counts = np.isfinite(views) if weight is None else np.isfinite(views) & (weight > 0)
    return _summed(whitened(model - at_voxel_resolution(views, resolution, counts), weight), views, counts)


def unseen_residuals(model: F32, views: F32, weight: F32 | None, resolution: ViewResolution) -> F64:
    """[view] root mean square of what a volume leaves, see `squares_left`, of views with a measured ray; [inf] if there
    is none.
    """
    left, _, rays = squares_left(model, views, weight, resolution)
    return np.sqrt(left[rays > 0] / rays[rays > 0]) if rays.any() else np.full(1, np.inf)


def residuals_of(volume: Volume, views: Views) -> F64:
    """`unseen_residuals` of a volume in views."""
    projector = Projector(views.geometry, volume.grid)
    weights = None if views.weights is None else projection_lines(views.weights[...])
    model = projector.forward_lines(volume_lines(volume.data))
    return unseen_residuals(model, projection_lines(views.data), weights, projector.resolution)


def _summed(left: F32, views: F32, counts: Mask) -> SquaresLeft:
    sums = [[np.square(view[counted], dtype=np.float64).sum() for view, counted in zip(images, counts, strict=True)]
            for images in (left, views)]  # fmt: skip
    return SquaresLeft(np.array(sums[0]), np.array(sums[1]), counts.sum(axis=(1, 2), dtype=np.float64))


def left_by_volume(
    volume: Volume, views: Views, most: int, progress: Callable[[int, int], None], *, beside_uniform: bool = False
) -> tuple[SquaresLeft, tuple[float, float] | None]:
    """What a volume leaves of at most `most` views, evenly spread.

    Of a detector with more than 2^17 pixels only bands of rows with so many pixels are used.

    Args:
        progress: how many of how many views were compared.
        beside_uniform: compare it with volumes of one density, too.

    Returns:
        The sums of these views, and where it is compared the residual in the differences of rays from the mean of their
        row: of the volume, and the lesser one of two uniform volumes with the density of least residual, a box and a
        cylinder that fill the slices. A volume that leaves more shows nothing of the sample yet. The means tell
        nothing: they hold matter beyond the field, too, which a right volume lacks. Both are 0 where views have no such
        differences.
    """
    some, grid = spread(np.arange(views.geometry.n_views), most), volume.grid
    _, y, x = grid.coordinates()
    inside = np.hypot(y[:, None], x) < grid.spacing[1] * min(grid.shape[1:]) / 2
    uniform = [Volume(np.broadcast_to(np.float32(at), grid.shape), grid) for at in (inside, True)]
    volumes = [volume, *uniform] if beside_uniform else [volume]
    bands = _bands(views, some, grid)
    # What is not looked at in bands of rows takes less memory in groups of views.
    groups = np.array_split(np.arange(some.size), 1 if views.geometry.rows_show_slices else min(some.size, _GROUPS))
    sums, products, total = np.zeros((3, some.size)), np.zeros((4, 4)), 0.0
    for n, (group, rows) in enumerate(((group, rows) for group in groups for rows in bands), 1):
        geometry, part, slices = views.geometry.select(some[group]), grid, slice(None)
        if len(bands) > 1:
            slices = rows
            _, geometry, part = part_of(geometry, grid, rows)
        projector = Projector(geometry, part)
        models = [projector.forward_lines(volume_lines(each.data[slices])) for each in volumes]
        lines = views.data[some[group], rows].swapaxes(1, 2)
        counts = np.isfinite(lines)
        if views.weights is not None:
            counts &= np.asarray(views.weights[some[group], rows] > 0).swapaxes(1, 2)
        seen = at_voxel_resolution(np.where(counts, lines, np.float32(0)), projector.resolution, counts)
        sums[:, group] += _summed(models[0] - seen, lines, counts)
        if beside_uniform:
            images = [_without_means(image, counts) for image in (seen, *models)]
            products += [[np.vdot(one, other) for other in images] for one in images]
            total += float(np.square(_without_means(lines, counts)).sum())
        progress(n * some.size // (len(bands) * len(groups)), some.size)
    return SquaresLeft(*sums), _along_rows(products, total) if beside_uniform else None


def _along_rows(products: F64, total: float) -> tuple[float, float]:
    """The residuals along rows from the products of the views, the volume and the two uniform ones."""
    if total == 0:
        return 0.0, 0.0
    squares = products[0, 0] - 2 * products[0, 1] + products[1, 1]
    norms = np.diag(products)[2:]
    least = products[0, 0] - np.divide(products[0, 2:] ** 2, norms, out=np.zeros(2), where=norms > 0).max()
    return math.sqrt(max(squares, 0.0) / total), math.sqrt(max(least, 0.0) / total)


def _without_means(lines: F32, known: Mask) -> F64:
    """The differences of known rays [view, col, row] from the mean of their row; 0 of the others."""
    values, n = np.where(known, lines, np.float64(0)), np.maximum(known.sum(axis=1, keepdims=True), 1)
    return np.where(known, values - values.sum(axis=1, keepdims=True) / n, 0)


def _bands(views: Views, some: I64, grid: Grid) -> list[slice]:
    """Bands of rows that represent the detector, at equal shares of the matter that these views show.

    All rows, unless the detector is large; one band if rows are not slices.
    """
    rows, cols = views.geometry.detector_shape
    bands = max(1, RAYS // (_ROWS * cols))
    if not views.geometry.rows_show_slices or grid != Grid.matching(views.geometry):
        return [slice(0, rows)]
    if rows <= bands * _ROWS:
        return [slice(first, min(first + _ROWS, rows)) for first in range(0, rows, _ROWS)]
    matter = np.maximum(sum(np.nansum(views.data[view], axis=1, dtype=np.float64) for view in some), 0)
    reached = np.cumsum(matter if matter.any() else np.ones(rows))
    middles = np.searchsorted(reached, (np.arange(bands) + 0.5) / bands * reached[-1])
    starts = np.unique(np.clip(middles - _ROWS // 2, 0, rows - _ROWS))
    return [slice(first, first + _ROWS) for first in starts.tolist()]
