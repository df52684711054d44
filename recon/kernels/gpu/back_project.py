"""FDK for projections in any pose, cone or parallel beam: the filter (torch) and the back-projection (Triton).

    depth = D + Dx i + Dy j + Dz k,   col = (C + Cx i + Cy j + Cz k) / depth,   row likewise

Voxels (i, j, k) are counted from [ny // 2, nx // 2, nz // 2], columns and rows from [cols // 2, rows // 2]. With 2048
voxels, float32 then gives positions within 2e-4 of a pixel. Depth is 1 at the axis, and everywhere in a parallel beam.
Each voxel sums over the projections in their order, so the same input gives bit-identical results.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from recon.base.arrays import F32, F64
from recon.base.geometry import Geometry
from recon.kernels.gpu import require
from recon.kernels.gpu.joseph import tiles_of

_OF_VIEW = tl.constexpr(12)  # three linear forms: column, row, depth


@triton.jit
def _form(terms, i, j, k):
    return tl.load(terms) + tl.load(terms + 1) * i + tl.load(terms + 2) * j + tl.load(terms + 3) * k


@triton.jit(do_not_specialize=["n_views", "cols", "rows", "ny", "nx", "nz"])
def _back_project(
    filtered, views, out, n_views, cols, rows, ny, nx, nz, EDGE: tl.constexpr, DEEP: tl.constexpr
):  # fmt: skip
    tiles_x, tiles_y = tl.cdiv(nx, EDGE), tl.cdiv(ny, EDGE)
    tile, lane = tl.program_id(0), tl.arange(0, EDGE * EDGE)
    x, y = tile % tiles_x * EDGE + lane % EDGE, tile // tiles_x % tiles_y * EDGE + lane // EDGE
    z = tile // (tiles_x * tiles_y) * DEEP + tl.arange(0, DEEP)
    live = ((x < nx) & (y < ny))[:, None] & (z < nz)[None, :]
    voxel = (y * nx + x).to(tl.int64)[:, None] * nz + z[None, :]
    # Lanes beyond the end repeat the last voxel and store nothing.
    i = (tl.minimum(x, nx - 1) - nx // 2).to(tl.float32)[:, None]
    j = (tl.minimum(y, ny - 1) - ny // 2).to(tl.float32)[:, None]
    k = (tl.minimum(z, nz - 1) - nz // 2).to(tl.float32)[None, :]
    col0, row0 = cols // 2, rows // 2
    sums = tl.load(out + voxel, live, 0.0)
    for v in range(n_views):
        view, image = views + _OF_VIEW * v, filtered + tl.cast(v, tl.int64) * cols * rows
        nearness = 1.0 / _form(view + 8, i, j, k)
        col, row = _form(view, i, j, k) * nearness, _form(view + 4, i, j, k) * nearness
        seen = (col >= -0.5 - col0) & (col <= cols - 0.5 - col0) & (row >= -0.5 - row0) & (row <= rows - 0.5 - row0)
        col = tl.minimum(tl.maximum(col, -1.0 * col0), cols - 1.0 - col0)
        row = tl.minimum(tl.maximum(row, -1.0 * row0), rows - 1.0 - row0)
        a, b = tl.floor(col), tl.floor(row)
        p, q = col - a, row - b
        low_col, low_row = a.to(tl.int32) + col0, b.to(tl.int32) + row0
        low, high = low_col * rows, tl.minimum(low_col + 1, cols - 1) * rows
        high_row = tl.minimum(low_row + 1, rows - 1)
        near, near_above = tl.load(image + low + low_row, seen, 0.0), tl.load(image + low + high_row, seen, 0.0)
        far, far_above = tl.load(image + high + low_row, seen, 0.0), tl.load(image + high + high_row, seen, 0.0)
        near += q * (near_above - near)
        far += q * (far_above - far)
        sums += tl.where(seen, nearness * nearness * (near + p * (far - near)), 0.0)
    tl.store(out + voxel, sums, live)


def filtered(
    views: F32, geometry: Geometry, weights: F64, zeros: tuple[int, int], responses: Iterable[tuple[Any, ...]]
) -> Tensor:
    """Projections [view, row, col], weighted and filtered as in `recon.voxels.direct`: [view, col, row] on the GPU."""
    (rows, cols), device = geometry.detector_shape, require("cuda")
    out = torch.empty((len(views), cols + sum(zeros), rows), dtype=torch.float32, device=device)
    col, row = (torch.arange(n, dtype=torch.float64, device=device) for n in (cols, rows))
    for view, (beyond, shape, gain) in enumerate(responses):
        image, weight, factor = (
            torch.tensor(np.ascontiguousarray(array), device=device) for array in (views[view], weights[view], gain)
        )
        weighed = image * weight
        if geometry.is_cone:
            col0, row0 = geometry.origin(view)
            u, v = (col - col0) * geometry.pixel_pitch, (row - row0) * geometry.pixel_pitch
            weighed *= geometry.sdd / torch.sqrt(geometry.sdd**2 + u**2 + v[:, None] ** 2)
        padded = torch.nn.functional.pad(weighed.float(), zeros)
        padded = padded[torch.arange(-beyond, rows + beyond, device=device).clamp(0, rows - 1)]
        filtered_image = torch.fft.irfft2(torch.fft.rfft2(padded, shape) * factor, shape)
        out[view] = filtered_image[beyond : beyond + rows, : out.shape[1]].T
    return out


def back_project(
    filtered: Tensor, axes: F64, origins: F64, sod: float, sdd: float, pitch: float, x: F64, y: F64, z: F64, out: Tensor
) -> None:
    """out[y, x, z] += Σ_view (sod / w)² filtered[view, col, row] bilinearly; lengths in mm, w the voxel's depth.

    A projection adds nothing to voxels that it does not see. Up to half a pixel beyond the centres of the outer pixels,
    their value is used.

    Args:
        axes: [view, 3, 3], along columns, rows and the beam. origins: [view, 2], pixel (col, row) of the axis.
        sod: 0: a parallel beam, where the factor is 1.
        x, y, z: evenly spaced.
        out: contiguous.
    """
    n_views, *pixels = filtered.shape
    magnify, per_depth = (sdd / (sod * pitch), 1 / sod) if sod > 0 else (1 / pitch, 0.0)
    along = axes * np.array([magnify, magnify, per_depth])[:, None]
    terms = np.empty((n_views, 3, 4))
    terms[..., 0] = along @ [c[c.size // 2] for c in (x, y, z)] + [0.0, 0.0, 1.0]
    terms[..., 1:] = along * [(c[-1] - c[0]) / max(c.size - 1, 1) for c in (x, y, z)]
    terms[:, :2] += (origins - [n // 2 for n in pixels])[..., None] * terms[:, 2:]
    edge, deep, jobs = tiles_of(out.shape)
    if jobs > 0:
        views = torch.from_numpy(terms.astype(np.float32)).to(out.device)
        _back_project[(jobs,)](filtered, views, out, *filtered.shape, *out.shape, EDGE=edge, DEEP=deep, num_warps=4)
