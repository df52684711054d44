"""Residuals: the difference between a volume and each projection, at the resolution of the voxels."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import numpy as np

from recon.base.arrays import F32, F64, I64, Mask
from recon.base.geometry import Geometry
from recon.base.slabs import part_of
from recon.base.view_data import Views
from recon.base.views import spread
from recon.base.volume import Grid, Volume
from recon.voxels.one_projection import BAND, AskedRays, RayCheck, in_bands
from recon.voxels.projector import Projector, projection_lines, volume_lines
from recon.voxels.resolution import ViewResolution, at_voxel_resolution
from recon.voxels.voxel_problem import whitened

RAYS = 2**17  # most pixels of a projection that are used. Bands of rows represent a large detector
_GROUPS = 4  # number of groups of projections that are computed one after the other, if rows do not show slices


class SquaresLeft(NamedTuple):
    """Sums over the measured rays of each projection [view].

    The sums are squares of the residual, squares of the projection itself, and the number of these rays."""

    squares: F64
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
        return math.sqrt(self.squares.sum() / self.own.sum())


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
    squares, _, rays = squares_left(model, views, weight, resolution)
    return np.sqrt(squares[rays > 0] / rays[rays > 0]) if rays.any() else np.full(1, np.inf)


def residuals_of(volume: Volume, views: Views) -> F64:
    """The `unseen_residuals` of a volume in these projections."""
    projector = Projector(views.geometry, volume.grid)
    weights = None if views.weights is None else projection_lines(views.weights[...])
    model = projector.forward_lines(volume_lines(volume.data))
    return unseen_residuals(model, projection_lines(views.data), weights, projector.resolution)


def _summed(residuals: F32, views: F32, counts: Mask) -> SquaresLeft:
    sums = [[np.square(view[counted], dtype=np.float64).sum() for view, counted in zip(images, counts, strict=True)]
            for images in (residuals, views)]  # fmt: skip
    return SquaresLeft(np.array(sums[0]), np.array(sums[1]), counts.sum(axis=(1, 2), dtype=np.float64))


class _Compared(NamedTuple):
    """Rays of some projections that are compared together, and the voxels through which they pass."""

    geometry: Geometry
    grid: Grid
    rows: slice
    views: I64
    positions: I64  # of the views among all compared ones


def residual(grid: Grid, views: Views, most_views: int) -> RayCheck[tuple[SquaresLeft, float]]:
    """The residual of a volume on this grid in at most `most_views` projections, evenly spread.

    If a detector has more than 2^17 pixels, only bands of rows with about this number of pixels are used.

    Returns:
        The check. Its result is the sums of these projections, and the residual of the volume along rows, see
        `uniform_residual`.
    """
    compared = list(_compared(grid, views, most_views))
    sums, squares_along_rows = np.zeros((3, 1 + max(int(each.positions[-1]) for each in compared))), np.zeros(2)

    def compare(part: _Compared, model: F32) -> None:
        lines, counts, measured = _measured(views, part)
        sums[:, part.positions] += _summed(model - measured, lines, counts)
        squares_along_rows[:] += [np.square(_without_means(image, counts)).sum() for image in (model - measured, lines)]

    parts = [AskedRays(each.views, each.rows, partial(compare, each)) for each in compared]
    return RayCheck(
        parts,
        lambda: (
            SquaresLeft(*sums),
            math.sqrt(squares_along_rows[0] / squares_along_rows[1]) if squares_along_rows[1] else 0.0,
        ),
    )


def uniform_residual(grid: Grid, views: Views, most_views: int) -> tuple[float, int]:
    """The residual along rows of a volume of uniform density, in the projections that `residual` compares.

    A residual along rows is computed after the mean of each row is subtracted, because the mean also contains material
    outside the field of view, which a correct volume does not contain. The uniform volume is a box or a cylinder that
    fills the slices, with the best density; the smaller of the two residuals counts. A volume with a larger residual
    does not show the sample yet.

    Returns:
        The residual (0 if the rays do not differ from the mean of their row), and the number of projected rays.
    """
    _, y, x = grid.coordinates()
    cylinder = (np.hypot(y[:, None], x) < grid.spacing[1] * min(grid.shape[1:]) / 2).astype(np.float32)
    squares_of_data, total, products, norms, rays = 0.0, 0.0, np.zeros(2), np.zeros(2), 0
    for part in _compared(grid, views, most_views):
        lines, counts, measured = _measured(views, part)
        projector, without_means = Projector(part.geometry, part.grid), _without_means(measured, counts)
        squares_of_data = squares_of_data + float(np.vdot(without_means, without_means))
        total = total + float(np.square(_without_means(lines, counts)).sum())
        for n, mask in enumerate((cylinder, np.ones_like(cylinder))):
            uniform = np.broadcast_to(mask, part.grid.shape)
            image = _without_means(projector.forward_lines(volume_lines(uniform)), counts)
            products[n] += np.vdot(without_means, image)
            norms[n] += np.vdot(image, image)
        rays += 2 * lines.size
    least_squares = squares_of_data - np.divide(products**2, norms, out=np.zeros(2), where=norms > 0).max()
    return math.sqrt(max(least_squares, 0.0) / total) if total else 0.0, rays


def _compared(grid: Grid, views: Views, most_views: int) -> Iterator[_Compared]:
    sampled_views, bands = spread(np.arange(views.geometry.n_views), most_views), in_bands(views.geometry, grid)
    # Without bands of rows, groups of projections save memory.
    for positions in np.array_split(np.arange(sampled_views.size), 1 if bands else min(sampled_views.size, _GROUPS)):
        geometry = views.geometry.select(sampled_views[positions])
        for rows in _bands(views, sampled_views) if bands else [slice(0, geometry.detector_shape[0])]:
            _, geometry_of_part, slices = part_of(geometry, grid, rows) if bands else (rows, geometry, grid)
            yield _Compared(geometry_of_part, slices, rows, sampled_views[positions], positions)


def _measured(views: Views, part: _Compared) -> tuple[F32, Mask, F32]:
    """The measured lines [view, col, row], a mask of the lines that count, and the lines at the resolution of
    voxels.
    """
    lines = views.data[part.views, part.rows].swapaxes(1, 2)
    counts = np.isfinite(lines)
    if views.weights is not None:
        counts &= np.asarray(views.weights[part.views, part.rows] > 0).swapaxes(1, 2)
    resolution = ViewResolution.of(part.geometry, part.grid)
    return lines, counts, at_voxel_resolution(np.where(counts, lines, np.float32(0)), resolution, counts)


def _without_means(lines: F32, known: Mask) -> F64:
    """The differences of known rays [view, col, row] from the mean of their row; 0 for unknown rays."""
    values, n = np.where(known, lines, np.float64(0)), np.maximum(known.sum(axis=1, keepdims=True), 1)
    return np.where(known, values - values.sum(axis=1, keepdims=True) / n, 0)


def _bands(views: Views, sampled_views: I64) -> list[slice]:
    """Bands of rows that represent the detector, at equal shares of the material that these projections show.

    All rows if the detector is not large.
    """
    rows, cols = views.geometry.detector_shape
    bands = max(1, RAYS // (BAND * cols))
    if rows <= bands * BAND:
        return [slice(first, min(first + BAND, rows)) for first in range(0, rows, BAND)]
    absorption = np.maximum(sum(np.nansum(views.data[view], axis=1, dtype=np.float64) for view in sampled_views), 0)
    cumulative = np.cumsum(absorption if absorption.any() else np.ones(rows))
    middles = np.searchsorted(cumulative, (np.arange(bands) + 0.5) / bands * cumulative[-1])
    first_rows = np.unique(np.clip(middles - BAND // 2, 0, rows - BAND))
    return [slice(first, first + BAND) for first in first_rows.tolist()]
