"""Residuals: the difference between a volume and each projection, at the resolution of the voxels."""

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

# most pixels of a projection that are used; rows of a band. Bands of rows represent a large detector.
RAYS, _ROWS = 2**17, 16
_GROUPS = 4  # number of groups of projections that are computed one after the other, if rows do not show slices


class SquaresLeft(NamedTuple):
    """Sums over the measured rays of each projection [view].

    The sums are squares of the residual, squares of the projection itself, and the number of these rays."""

    left: F64
    own: F64
    rays: F64

    @property
    def residual(self) -> float:
        """The data residual of all these projections, as every command reports it.

        Raises:
            ValueError: all projections are zero.
        """
        if not self.own.any():
            raise ValueError("all projections are zero, so no residual can be computed")
        return math.sqrt(self.left.sum() / self.own.sum())


def squares_left(model: F32, views: F32, weight: F32 | None, resolution: ViewResolution) -> SquaresLeft:
    """Sums of the squared residual of each projection, at the resolution of the voxels.

    At this resolution the residual of the true volume is only the noise. At the resolution of the measured projections,
    the true volume would have a larger residual than a sharper one.

    Args:
        model: [view, col, row], the projection of the volume by a `Projector` of this resolution.
        views: measured line integrals, minus the part that no voxel can explain. Values that are not finite do not
            count.
        weight: weights of the rays; None: 1 for all.
    """
    counts = np.isfinite(views) if weight is None else np.isfinite(views) & (weight > 0)
    return _summed(whitened(model - at_voxel_resolution(views, resolution, counts), weight), views, counts)


def unseen_residuals(model: F32, views: F32, weight: F32 | None, resolution: ViewResolution) -> F64:
    """[view] root mean square of the residuals (see `squares_left`), for projections with a measured ray; [inf] if no
    projection has one.
    """
    left, _, rays = squares_left(model, views, weight, resolution)
    return np.sqrt(left[rays > 0] / rays[rays > 0]) if rays.any() else np.full(1, np.inf)


def residuals_of(volume: Volume, views: Views) -> F64:
    """The `unseen_residuals` of a volume in these projections."""
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
    """The residual of a volume in at most `most` projections, evenly spread.

    If a detector has more than 2^17 pixels, only bands of rows with about this number of pixels are used.

    Args:
        progress: function called with the number of projections compared so far, and their total number.
        beside_uniform: True: also compare the volume with volumes of uniform density.

    Returns:
        The sums of these projections. With `beside_uniform`, also two residuals of the differences of rays from the
        mean of their row. The first is that of the volume. The second is that of a uniform box or cylinder that fills
        the slices, with the best density; the smaller of the two counts. A volume with a larger residual than this
        shows nothing of the sample yet. The means of rows are left out, because they also contain material outside the
        field of view, which a correct volume does not contain. Both residuals are 0 if the projections have no such
        differences.
    """
    some, grid = spread(np.arange(views.geometry.n_views), most), volume.grid
    _, y, x = grid.coordinates()
    inside = np.hypot(y[:, None], x) < grid.spacing[1] * min(grid.shape[1:]) / 2
    uniform = [Volume(np.broadcast_to(np.float32(at), grid.shape), grid) for at in (inside, True)]
    volumes = [volume, *uniform] if beside_uniform else [volume]
    bands = _bands(views, some, grid)
    # Without bands of rows, groups of projections save memory.
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
    """The residuals along rows, from the products of the projections, the volume and the two uniform volumes."""
    if total == 0:
        return 0.0, 0.0
    squares = products[0, 0] - 2 * products[0, 1] + products[1, 1]
    norms = np.diag(products)[2:]
    least = products[0, 0] - np.divide(products[0, 2:] ** 2, norms, out=np.zeros(2), where=norms > 0).max()
    return math.sqrt(max(squares, 0.0) / total), math.sqrt(max(least, 0.0) / total)


def _without_means(lines: F32, known: Mask) -> F64:
    """The differences of known rays [view, col, row] from the mean of their row; 0 for unknown rays."""
    values, n = np.where(known, lines, np.float64(0)), np.maximum(known.sum(axis=1, keepdims=True), 1)
    return np.where(known, values - values.sum(axis=1, keepdims=True) / n, 0)


def _bands(views: Views, some: I64, grid: Grid) -> list[slice]:
    """Bands of rows that represent the detector, at equal shares of the material that these projections show.

    All rows if the detector is not large; one band if rows do not show slices.
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
