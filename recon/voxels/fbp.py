"""Filtered back-projection for parallel beam: the fast baseline, in 1/mm.

f(x, y) = ∫₀^π q_θ(x cos θ + y sin θ) dθ, where q_θ is a view convolved with the band-limited ramp
(Kak & Slaney 1988, eq. 3.61 and 3.69). Rows are independent, so the work runs in slabs of rows with the row
index fastest: one interpolation in the plane serves a whole slab of slices.
"""

from __future__ import annotations

import math
from typing import Literal, get_args

import numpy as np
from numba import get_num_threads, njit, prange
from numpy.typing import NDArray
from scipy import fft

from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.kernels.cpu.activation import OPTIONS
from recon.voxels.view_weights import ray_weights

Filter = Literal["ram-lak", "shepp-logan", "hann"]

_SLAB_BYTES = 128 * 2**20  # filtered views held at a time


def _transfer(n: int, pixel_pitch: float, filter: Filter) -> NDArray[np.float32]:
    """Transfer function [n // 2 + 1] of the ramp for a transform of n samples, 1/mm."""
    # The kernel is sampled in space and transformed: sampling |ω| instead would lose the mean value of the volume.
    k = np.minimum(np.arange(n), n - np.arange(n))
    kernel = np.zeros(n)
    kernel[0] = 1 / 4
    odd = k % 2 == 1
    kernel[odd] = -1 / (np.pi * k[odd]) ** 2
    response = fft.rfft(kernel).real / pixel_pitch
    f = np.arange(response.size) / n  # cycles a sample; Nyquist is 1/2
    if filter == "shepp-logan":
        response *= np.sinc(f)
    elif filter == "hann":
        response *= 0.5 + 0.5 * np.cos(2 * np.pi * f)
    return response.astype(np.float32)


def filter_projections(
    projections: NDArray[np.float32], pixel_pitch: float = 1.0, filter: Filter = "ram-lak"
) -> NDArray[np.float32]:
    """Convolve every detector row with the band-limited ramp (Kak & Slaney 1988, eq. 3.61), zero outside the detector.

    Args:
        projections: float32 [..., col], line integrals.
        pixel_pitch: mm.
        filter: the window on the ramp, 1 at zero frequency: none (ram-lak), sinc (shepp-logan), raised cosine (hann).

    Returns:
        float32 of the same shape, 1/mm for dimensionless line integrals.

    Raises:
        ValueError: for an unknown filter.
    """
    if filter not in get_args(Filter):
        raise ValueError(f"unknown filter {filter!r}; use one of {', '.join(get_args(Filter))}")
    cols = projections.shape[-1]
    n = fft.next_fast_len(2 * cols, real=True)  # no wrap-around for kernels as long as the row
    spectrum = fft.rfft(np.asarray(projections, np.float32), n, axis=-1, workers=get_num_threads())
    spectrum *= _transfer(n, pixel_pitch, filter)
    return fft.irfft(spectrum, n, axis=-1, workers=get_num_threads())[..., :cols]


@njit(**OPTIONS)
def _back_project(filtered, cosines, sines, axis_cols, x, y, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """out[z, y, x] = Σ_view filtered[view, u(x, y), z] by linear interpolation; x and y in pixels."""
    views, cols, nz = filtered.shape
    nx, ny = x.size, y.size
    block = 32  # x by z accumulators of one job stay in the first cache
    blocks = (nx + block - 1) // block
    for job in prange(ny * blocks):
        j = job // blocks
        i0 = (job - j * blocks) * block
        i1 = min(i0 + block, nx)
        acc = np.zeros((block, nz), np.float32)
        for v in range(views):
            c = cosines[v]
            offset = y[j] * sines[v] + axis_cols[v]
            for i in range(i0, i1):
                t = x[i] * c + offset
                if t < -0.5 or t > cols - 0.5:
                    continue
                t = min(max(t, 0.0), cols - 1.0)
                col = math.floor(t)
                upper = min(col + 1, cols - 1)
                w1 = np.float32(t - col)
                w0 = np.float32(1) - w1
                a = acc[i - i0]
                p0 = filtered[v, col]
                p1 = filtered[v, upper]
                for k in range(nz):
                    a[k] += w0 * p0[k] + w1 * p1[k]
        for k in range(nz):
            for i in range(i0, i1):
                out[k, j, i] = acc[i - i0, k]


def _rows_at(projections: NDArray[np.float32], rows: NDArray[np.float64]) -> NDArray[np.float32]:
    """Views [view, len(rows), col] at fractional rows by linear interpolation; rows off the detector are zero."""
    n = projections.shape[1]
    inside = (rows >= -0.5) & (rows <= n - 0.5)
    clamped = np.clip(rows, 0, n - 1)
    lower = np.floor(clamped).astype(np.intp)
    weight = (clamped - lower).astype(np.float32)
    if np.array_equal(rows, lower):
        return projections[:, lower]
    upper = np.minimum(lower + 1, n - 1)
    low_part = projections[:, lower] * np.where(inside, 1 - weight, 0).astype(np.float32)[:, None]
    return low_part + projections[:, upper] * np.where(inside, weight, 0).astype(np.float32)[:, None]


def _slab(projections: NDArray[np.float32], geometry: Geometry, rows: NDArray[np.float64]) -> NDArray[np.float32]:
    """All views at the detector rows that show the same heights, each where it was shifted to."""
    if not geometry.shifts[:, 1].any():
        return _rows_at(projections, rows)
    moved = zip(projections, geometry.shifts[:, 1], strict=True)
    return np.concatenate([_rows_at(view[None], rows + shift) for view, shift in moved])


def fbp(
    projections: NDArray[np.float32], geometry: Geometry, grid: Grid | None = None, filter: Filter = "ram-lak"
) -> NDArray[np.float32]:
    """Reconstruct by filtered back-projection (Kak & Slaney 1988, §3.3), views in any order.

    Voxels take the filtered views by linear interpolation at their centres: for voxels larger than a pixel bin the
    projections first. A voxel that a view does not see gets nothing from that view, unless its opposite does: a full
    turn with the axis off the middle of the detector, or beside it, reaches as far as its far columns.

    Args:
        projections: float32 [view, row, col], line integrals (dimensionless).
        geometry: where the views' rays run.
        grid: voxels wanted; None: one a pixel, `Grid.matching(geometry)`.
        filter: "ram-lak", "shepp-logan" or "hann".

    Returns:
        float32 [z, y, x], 1/mm (1/pixel for a pitch of 1).

    Raises:
        ValueError: where the shape does not belong to the geometry, values are not finite, the filter is unknown, or
            the geometry is a cone, rolled or tilted.
    """
    expected = (geometry.n_views, *geometry.detector_shape)
    if projections.shape != expected:
        raise ValueError(
            f"projections have shape {projections.shape}, the geometry expects [view, row, col] {expected}"
        )
    if geometry.is_cone:
        raise ValueError("FBP is for a parallel beam; a cone beam is for fdk")
    if not geometry.is_straight:
        raise ValueError("FBP takes straight views only; these are rolled or tilted: rotate the images first")
    grid = Grid.matching(geometry) if grid is None else grid
    pitch = geometry.pixel_pitch
    z, y, x = (axis / pitch for axis in grid.coordinates())
    rows = z + geometry.axis_row
    weights, zeros = ray_weights(geometry)
    axis_cols = geometry.axis_col + geometry.shifts[:, 0] + zeros[0]
    share = weights.astype(np.float32)[:, None]
    out = np.empty(grid.shape, np.float32)
    views, cols = geometry.n_views, geometry.detector_shape[1] + sum(zeros)
    slab = int(np.clip(_SLAB_BYTES // (4 * views * cols), 8, 64))
    for start in range(0, rows.size, slab):
        part = slice(start, start + slab)
        weighed = _slab(projections, geometry, rows[part]) * share
        if any(zeros):
            weighed = np.pad(weighed, ((0, 0), (0, 0), zeros))
        filtered = filter_projections(weighed, pitch, filter)
        if not np.isfinite(filtered).all():
            raise ValueError("projections hold NaN or infinite values; correct them before reconstruction")
        columns = np.ascontiguousarray(filtered.transpose(0, 2, 1))
        _back_project(columns, np.cos(geometry.angles), np.sin(geometry.angles), axis_cols, x, y, out[part])
    return out
