"""orthogonal_slices: three slices through the sample, by FBP of the projections so far, in a fraction of a second."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from recon.base.arrays import F32, F64
from recon.base.geometry import Geometry
from recon.base.views import spread_views
from recon.base.volume import Grid
from recon.voxels.fbp import continuation, continued, fbp, filter_projections
from recon.voxels.view_weights import angular_weights, ray_weights

_SIDE = 511  # largest side of a slice in voxels; wider projections are binned
# largest number of projections that are used, enough for this side. If there are more, some are left out, evenly by
# angle.
_VIEWS = 400
_MATERIAL_SHARE = 0.5  # share of the 99th percentile; the slices cross in the middle of the voxels above it
_VIEWS_AT_ONCE = 32  # number of projections that are filtered together


@dataclass(frozen=True, eq=False)
class OrthogonalSlices:
    """Three slices that cross in one point.

    Attributes:
        images: float32 [y, x], [z, x] and [z, y], 1/mm.
        centre: z, y and x in mm of the point in which the slices cross.
        pixel: side of a voxel in mm.
        covered: radians of the 180° that the projections cover; π if no wedge is missing.
    """

    images: tuple[F32, F32, F32]
    centre: tuple[float, float, float]
    pixel: float
    covered: float


def orthogonal_slices(views: Sequence[F32], geometry: Geometry) -> OrthogonalSlices:
    """The middle slice perpendicular to the axis, and two slices along the axis through the middle of its bright part.

    Each projection is weighted by its share of the 180°, so projections may be in any order. Only the slices are
    back-projected. The time grows with the number of projections up to 400.

    Args:
        views: line integrals [row, col], one for each projection of the geometry.
        geometry: geometry of a parallel beam, without roll, tilt and shifts along the axis.

    Raises:
        ValueError: there are fewer than two projections, or the geometry is not of this kind.
    """
    if len(views) != geometry.n_views or len(views) < 2:
        raise ValueError(
            f"slices need at least two projections and one angle for each, got {len(views)} projections and "
            f"{geometry.n_views} angles"
        )
    if geometry.is_cone or not geometry.is_straight or geometry.shifts[:, 1].any():
        raise ValueError("slices during a scan need a parallel beam without roll, tilt and shifts along the axis")
    covered = float(angular_weights(geometry.angles).sum())
    view_numbers = spread_views(geometry.angles, _VIEWS, np.arange(len(views)))
    factor = math.ceil(max(geometry.detector_shape) / _SIDE)
    data = np.stack([_binned(np.asarray(views[i], np.float32), factor) for i in view_numbers])
    geometry = geometry.select(view_numbers).binned(factor)
    grid = Grid.matching(geometry)
    nz, ny, nx = grid.shape
    middle = grid.part(slice(nz // 2, nz // 2 + 1), slice(0, ny), slice(0, nx))
    across = fbp(data, geometry, middle, "hann")[0]
    weights = across >= _MATERIAL_SHARE * np.percentile(across, 99)
    j, i = (int(np.average(np.arange(n), weights=weights.sum(axis))) for axis, n in ((1, ny), (0, nx)))
    z, y, x = grid.coordinates()
    lines = np.stack([np.concatenate([x, np.full(ny, x[i])]), np.concatenate([np.full(nx, y[j]), y])])
    along = _along(data, geometry, lines)
    images = (across, along[:nx].T.copy(), along[nx:].T.copy())
    return OrthogonalSlices(images, (float(z[nz // 2]), float(y[j]), float(x[i])), grid.voxel_size, covered)


def _binned(view: F32, factor: int) -> F32:
    """Means [row, col] of factor x factor pixels; pixels at the ends that do not fill a bin are dropped."""
    rows, cols = (n // factor * factor for n in view.shape)
    down = np.add.reduce([view[k:rows:factor, :cols] for k in range(factor)])
    return np.asarray(np.add.reduce([down[:, k::factor] for k in range(factor)]) / np.float32(factor**2))


def _along(data: F32, geometry: Geometry, points: F64) -> F32:
    """FBP float32 [point, row] (1/mm) of line integrals [view, row, col], with the weights of `fbp`.

    The values are on lines along the axis through the points (x, y) [2, point] in mm.
    """
    weights, zeros = ray_weights(geometry)
    out = np.zeros((points.shape[1], data.shape[1]), np.float32)
    beyond, weights = continuation(data.mean(axis=0), geometry, weights, zeros, "hann")
    shares, pitch = weights.astype(np.float32)[:, None, 1:-1], geometry.pixel_pitch
    for first in range(0, geometry.n_views, _VIEWS_AT_ONCE):
        part = slice(first, first + _VIEWS_AT_ONCE)
        weighed = np.pad(data[part] * shares[part], ((0, 0), (0, 0), zeros))
        filtered = filter_projections(weighed, pitch, "hann")
        if beyond is not None:
            filtered += continued(beyond, data[part], weights[part])
        columns = np.ascontiguousarray(filtered.transpose(0, 2, 1))
        for angle, shift, view in zip(geometry.angles[part], geometry.shifts[part, 0], columns, strict=True):
            cols = (points[0] * math.cos(angle) + points[1] * math.sin(angle)) / pitch
            cols += geometry.axis_col + shift + zeros[0]
            low = np.clip(np.floor(cols).astype(np.intp), 0, len(view) - 2)
            near = (cols - low).astype(np.float32)[:, None]
            inside = ((cols >= -0.5) & (cols <= len(view) - 0.5)).astype(np.float32)[:, None]
            np.clip(near, 0, 1, out=near)
            out += inside * ((1 - near) * view[low] + near * view[low + 1])
    return out
