"""Filtered back-projection of a cone beam (Feldkamp, Davis & Kress 1984), in 1/mm."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.kernels.cpu.activation import F32, OPTIONS
from recon.kernels.cpu.joseph import calls
from recon.voxels.fbp import Filter, filter_projections
from recon.voxels.projector import volume_slices
from recon.voxels.view_weights import cone_weights

F64 = NDArray[np.float64]

_f = np.float32
_SAMPLES = 4  # samples of a projector that take as long as a voxel in a view
SLAB_BYTES = 128 * 2**20  # filtered views held at a time


@njit(**OPTIONS)
def _back_project(
    filtered: F32, cosines: F64, sines: F64, col0: F64, row0: F64, sod: float, sdd: float, pitch: float,
    x: F64, y: F64, z: F64, out: F32,
) -> None:  # fmt: skip
    """out[y, x, z] += Σ_view (sod / w)² filtered[view, col, row] bilinearly; lengths in mm, w the voxel's depth."""
    views, cols, rows = filtered.shape[0], filtered.shape[1] - 2, filtered.shape[2] - 2
    nx, ny, nz = x.size, y.size, z.size
    step = (z[1] - z[0]) if nz > 1 else 1.0
    for j in prange(ny):
        line = np.zeros(rows + 4, np.float32)
        for v in range(views):
            c, s = cosines[v], sines[v]
            for i in range(nx):
                depth = sod - x[i] * s + y[j] * c
                magnify = sdd / (depth * pitch)
                col = (x[i] * c + y[j] * s) * magnify + col0[v] + 1.0
                if not (col >= 0.5 and col <= cols + 0.5):
                    continue
                low = math.floor(col)
                part = _f(col - low)
                share = _f((sod / depth) ** 2)
                climb = step * magnify
                base = z[0] * magnify + row0[v] + 1.0
                first = math.ceil(max((0.5 - base) / climb, 0.0))
                end = math.floor(min((rows + 0.5 - base) / climb, nz - 1.0)) + 1
                if end <= first:
                    continue
                a, b = filtered[v, low], filtered[v, low + 1]
                r0 = max(0, math.floor(base + climb * first) - 1)
                r1 = min(rows + 2, math.ceil(base + climb * (end - 1)) + 2)
                for row in range(r0, r1):
                    line[row] = share * (a[row] + part * (b[row] - a[row]))
                target = out[j, i, first:end]
                base += climb * first
                for k in range(end - first):
                    row = base + climb * k
                    whole = np.uint32(row)
                    rest = _f(row - whole)
                    target[k] += line[whole] + rest * (line[whole + np.uint32(1)] - line[whole])


def fdk(
    projections: NDArray[np.float32],
    geometry: Geometry,
    grid: Grid | None = None,
    filter: Filter = "ram-lak",
    on_block: Callable[[int, int], None] = lambda done, of: None,
) -> NDArray[np.float32]:
    """Reconstruct a cone-beam scan (Feldkamp, Davis & Kress 1984, J. Opt. Soc. Am. A 1, 612), views in any order.

    Exact in the plane of the source. Above and below, values fall off with the square of the cone's angle, and flat
    interfaces across the axis blur. A full turn must see the whole width of the object, on one side of the axis or on
    both (see `fan_shares`). A short scan, of 180 degrees and the fan's angle or more, must see it in every view (see
    `cone_weights`). Matter that views cut off brightens the rim. A voxel that a view does not see gets nothing from it.

    Args:
        projections: float32 [view, row, col], line integrals (dimensionless).
        geometry: a cone, straight (no roll, no tilt); views may be shifted.
        grid: of the volume; None: `Grid.matching(geometry)`.
        filter: "ram-lak", "shepp-logan" or "hann".
        on_block: told how many of how many layers are done, counted by their views.

    Returns:
        float32 [z, y, x], 1/mm.

    Raises:
        ValueError: for a parallel beam, rolled or tilted views, too short a scan, an unknown filter. Also for a shape
            that does not belong to the geometry, values that are not finite, or a box that reaches the source.
    """
    grid = Grid.matching(geometry) if grid is None else grid
    _refuse(projections.shape, geometry, grid)
    weights, (before, after) = cone_weights(geometry)
    z, y, x = grid.coordinates()
    rows, cols = geometry.detector_shape
    volume = np.zeros((y.size, x.size, z.size), np.float32)
    slab = max(1, SLAB_BYTES // (4 * rows * cols))
    for start in range(0, geometry.n_views, slab):
        part = geometry.select(slice(start, start + slab))
        rays = weights[start : start + slab]
        prepared = _prepared(projections[start : start + slab], part, rays, (before, after), filter)
        if not np.isfinite(prepared).all():
            raise ValueError("projections hold NaN or infinite values; correct them before reconstruction")
        for layers in calls(y.size, _SAMPLES * part.n_views * x.size * z.size):
            some = slice(layers.start, layers.stop)
            _back_project(
                prepared, np.cos(part.angles), np.sin(part.angles), part.axis_col + part.shifts[:, 0] + before,
                part.axis_row + part.shifts[:, 1], part.sod, part.sdd, part.pixel_pitch, x, y[some], z, volume[some],
            )  # fmt: skip
            on_block((start * y.size + part.n_views * layers.stop) // geometry.n_views, y.size)
    return volume_slices(volume)


def _refuse(shape: tuple[int, ...], geometry: Geometry, grid: Grid) -> None:
    """ValueError for views or a box that FDK does not take."""
    expected = (geometry.n_views, *geometry.detector_shape)
    if shape != expected:
        raise ValueError(f"projections have shape {shape}, the geometry expects [view, row, col] {expected}")
    if not geometry.is_cone:
        raise ValueError("FDK is for a cone beam; a parallel beam is for fbp")
    if not geometry.is_straight:
        raise ValueError("FDK takes straight views only; these are rolled or tilted: `direct` takes them")
    refuse_climbing(geometry)
    reach = float(np.hypot(*np.abs(grid.edges[:, :2]).max(0)))
    if reach >= geometry.sod:
        raise ValueError(
            f"the box reaches {reach:.4g} mm from the rotation axis, the source stands at {geometry.sod:.4g}"
        )


def refuse_climbing(geometry: Geometry) -> None:
    """ValueError for views that climb along the axis: each voxel would miss the views that do not see it."""
    if geometry.climbs:
        raise ValueError(
            f"views climb by {np.ptp(geometry.shifts[:, 1]):.4g} of {geometry.detector_shape[0]} rows. Direct methods "
            "have weights for that in straight views of a parallel beam only: use an iterative method (fista-tv, sirt)"
        )


def _prepared(views: F32, geometry: Geometry, weights: F64, beyond: tuple[int, int], filter: Filter) -> F32:
    """Views times the weights [view, col] and the cosine of each ray, filtered. Columns of zeros stand before and
    after. Shape [view, col + 2, row + 2], the rim twice."""
    rows, cols = geometry.detector_shape
    out = np.empty((geometry.n_views, sum(beyond) + cols + 2, rows + 2), np.float32)
    for view in range(geometry.n_views):
        col0, row0 = geometry.origin(view)
        u = (np.arange(cols) - col0) * geometry.pixel_pitch
        v = (np.arange(rows) - row0) * geometry.pixel_pitch
        cosine = geometry.sdd / np.sqrt(geometry.sdd**2 + u**2 + v[:, None] ** 2)
        # The ramp is that of a detector at the rotation axis.
        weighed = np.pad((views[view] * (weights[view] * cosine)).astype(np.float32), ((0, 0), beyond))
        out[view] = np.pad(filter_projections(weighed, geometry.sample_pitch, filter).T, 1, mode="edge")
    return out
