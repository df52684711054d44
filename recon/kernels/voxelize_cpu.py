"""Voxelisation of Gaussians on the CPU: any box of voxels, sixteen lanes along x, ten-moment backward.

With H = S⁻¹ Rᵀ the exponent is -1/2 |H δ|². Its gradient needs per Gaussian N₀ = Σ g G, N₁ = Σ g G δ, N₂ = Σ g G δδᵀ:

    ∂ρ = N₀,   ∂p = ρ HᵀH N₁,   ∂H = -ρ H N₂
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from recon.kernels import lanes
from recon.kernels.activation import F32, OPTIONS

_f = np.float32
_SLAB = 4  # slices a task: small enough to share out a 32-voxel cube, large enough to keep the rows in cache


@njit(**OPTIONS)
def _boxes(
    means: F32,
    scales: F32,
    rotations: F32,
    densities: F32,
    origin: NDArray[np.float64],
    per_mm: float,
    shape: tuple[int, int, int],
    faint: float,
    cut: float,
    table: F32,
    boxes: NDArray[np.int32],
) -> None:
    """Voxel-unit centre, precision (6) and box of each Gaussian; an empty box where it misses the grid or is faint."""
    per = _f(per_mm)
    for i in prange(densities.shape[0]):
        for k in range(6):
            boxes[i, k] = 0
        density = densities[i]
        if not density > _f(faint):
            continue
        reach = min(_f(cut), np.sqrt(_f(2) * np.log(density / _f(faint)))) * per
        r, sc = rotations[i], scales[i]
        hit = True
        for axis in range(3):
            r0, r1, r2 = r[3 * axis] * sc[0], r[3 * axis + 1] * sc[1], r[3 * axis + 2] * sc[2]
            half = reach * np.sqrt(r0 * r0 + r1 * r1 + r2 * r2)
            centre = _f((means[i, axis] - origin[axis]) * per_mm)
            size = shape[2 - axis]
            table[i, axis] = centre
            if not (centre + half >= 0 and centre - half <= size - 1):
                hit = False
                break
            boxes[i, 2 * axis] = max(0, math.ceil(centre - half))
            boxes[i, 2 * axis + 1] = min(size, math.floor(centre + half) + 1)
        if not hit:
            boxes[i, 4] = boxes[i, 5] = 0
            continue
        h = np.empty((3, 3), np.float32)
        for k in range(3):
            inverse = _f(1) / (sc[k] * per)
            for j in range(3):
                h[k, j] = r[3 * j + k] * inverse
        table[i, 3] = h[0, 0] * h[0, 0] + h[1, 0] * h[1, 0] + h[2, 0] * h[2, 0]  # xx
        table[i, 4] = h[0, 0] * h[0, 1] + h[1, 0] * h[1, 1] + h[2, 0] * h[2, 1]  # xy
        table[i, 5] = h[0, 0] * h[0, 2] + h[1, 0] * h[1, 2] + h[2, 0] * h[2, 2]  # xz
        table[i, 6] = h[0, 1] * h[0, 1] + h[1, 1] * h[1, 1] + h[2, 1] * h[2, 1]  # yy
        table[i, 7] = h[0, 1] * h[0, 2] + h[1, 1] * h[1, 2] + h[2, 1] * h[2, 2]  # yz
        table[i, 8] = h[0, 2] * h[0, 2] + h[1, 2] * h[1, 2] + h[2, 2] * h[2, 2]  # zz


@njit(inline="always", fastmath=True)
def _exponents(table, i, z, y):  # type: ignore[no-untyped-def]
    """Row (z, y) of Gaussian i: exponent = a dx² + b dx + c."""
    dy, dz = _f(y) - table[i, 1], _f(z) - table[i, 2]
    b = -(table[i, 4] * dy + table[i, 5] * dz)
    c = _f(-0.5) * (table[i, 6] * dy * dy + _f(2) * table[i, 7] * dy * dz + table[i, 8] * dz * dz)
    return b, c


@njit(**OPTIONS)
def _fill(table: F32, boxes: NDArray[np.int32], densities: F32, hits: NDArray[np.int64], volume: F32, ny: int) -> None:
    """volume [z * y, x + 16]: each task owns `_SLAB` slices, so nothing is shared."""
    nz = volume.shape[0] // ny
    for task in prange((nz + _SLAB - 1) // _SLAB):
        z_low, z_high = task * _SLAB, min(nz, (task + 1) * _SLAB)
        for position in range(hits.shape[0]):
            i = hits[position]
            z0, z1 = max(z_low, boxes[i, 4]), min(z_high, boxes[i, 5])
            a, density = _f(-0.5) * table[i, 3], densities[i]
            for z in range(z0, z1):
                for y in range(boxes[i, 2], boxes[i, 3]):
                    b, c = _exponents(table, i, z, y)
                    for start in range(boxes[i, 0], boxes[i, 1], 16):
                        dx = lanes.iota() + (_f(start) - table[i, 0])
                        value = lanes.exp(dx * (dx * a + b) + c) * density
                        row = z * ny + y
                        lanes.store(volume, row, start, lanes.load(volume, row, start) + value)


@njit(**OPTIONS)
def _gather(
    table: F32,
    boxes: NDArray[np.int32],
    hits: NDArray[np.int64],
    gradient: F32,
    ny: int,
    scales: F32,
    rotations: F32,
    densities: F32,
    per_mm: float,
    means_too: bool,
    d_means: F32,
    d_log_scales: F32,
    d_rotations: F32,
    d_densities: F32,
) -> None:
    per = _f(per_mm)
    for position in prange(hits.shape[0]):
        i = hits[position]
        n0 = nx = ny1 = nz1 = xx = xy = xz = yy = yz = zz = _f(0)
        a = _f(-0.5) * table[i, 3]
        for start in range(boxes[i, 0], boxes[i, 1], 16):
            dx = lanes.iota() + (_f(start) - table[i, 0])
            s0, sy, sz = lanes.zero(), lanes.zero(), lanes.zero()
            syy, syz, szz = lanes.zero(), lanes.zero(), lanes.zero()
            for z in range(boxes[i, 4], boxes[i, 5]):
                dz = _f(z) - table[i, 2]
                for y in range(boxes[i, 2], boxes[i, 3]):
                    dy = _f(y) - table[i, 1]
                    b, c = _exponents(table, i, z, y)
                    value = lanes.load(gradient, z * ny + y, start) * lanes.exp(dx * (dx * a + b) + c)
                    s0, sy, sz = s0 + value, sy + value * dy, sz + value * dz
                    syy, syz, szz = syy + value * (dy * dy), syz + value * (dy * dz), szz + value * (dz * dz)
            first = dx * s0
            n0 += lanes.total(s0)
            nx += lanes.total(first)
            ny1 += lanes.total(sy)
            nz1 += lanes.total(sz)
            xx += lanes.total(dx * first)
            xy += lanes.total(dx * sy)
            xz += lanes.total(dx * sz)
            yy += lanes.total(syy)
            yz += lanes.total(syz)
            zz += lanes.total(szz)
        density, r, sc = densities[i], rotations[i], scales[i]
        d_densities[i] += n0
        if means_too:
            factor = density * per
            d_means[i, 0] += factor * (table[i, 3] * nx + table[i, 4] * ny1 + table[i, 5] * nz1)
            d_means[i, 1] += factor * (table[i, 4] * nx + table[i, 6] * ny1 + table[i, 7] * nz1)
            d_means[i, 2] += factor * (table[i, 5] * nx + table[i, 7] * ny1 + table[i, 8] * nz1)
        for k in range(3):
            inverse = _f(1) / (sc[k] * per)
            h0, h1, h2 = r[k] * inverse, r[3 + k] * inverse, r[6 + k] * inverse
            g0 = -density * (h0 * xx + h1 * xy + h2 * xz)
            g1 = -density * (h0 * xy + h1 * yy + h2 * yz)
            g2 = -density * (h0 * xz + h1 * yz + h2 * zz)
            d_log_scales[i, k] -= g0 * h0 + g1 * h1 + g2 * h2
            d_rotations[i, k] += g0 * inverse
            d_rotations[i, 3 + k] += g1 * inverse
            d_rotations[i, 6 + k] += g2 * inverse


class Layout:
    """Where a set of Gaussians falls on one grid; shared by the forward and the backward pass."""

    def __init__(
        self,
        means: F32,
        scales: F32,
        rotations: F32,
        densities: F32,
        origin: tuple[float, float, float],
        voxel_size: float,
        shape: tuple[int, int, int],
        faint: float,
        cut: float,
    ) -> None:
        """`origin` is the centre (x, y, z) of voxel [0, 0, 0] in mm; a Gaussian ends where it falls
        below `faint` (a density) and at the latest after `cut` standard deviations."""
        self.parameters = (means, scales, rotations, densities)
        self.per_mm, self.shape = 1.0 / voxel_size, shape
        self.table = np.empty((densities.shape[0], 9), np.float32)
        self.boxes = np.empty((densities.shape[0], 6), np.int32)
        corner = np.asarray(origin, np.float64)
        _boxes(means, scales, rotations, densities, corner, self.per_mm, shape, faint, cut, self.table, self.boxes)
        extent = self.boxes[:, 1::2] - self.boxes[:, 0::2]
        self.hits = np.flatnonzero((extent > 0).all(axis=1))

    def fill(self) -> F32:
        """Density [z, y, x] at the voxel centres."""
        nz, ny, nx = self.shape
        padded = np.zeros((nz * ny, nx + lanes.WIDTH), np.float32)
        _fill(self.table, self.boxes, self.parameters[3], self.hits, padded, ny)
        return padded.reshape(nz, ny, -1)[:, :, :nx]

    def backward(
        self,
        gradient: F32,
        d_means: F32,
        d_log_scales: F32,
        d_rotations: F32,
        d_densities: F32,
        *,
        means_too: bool = True,
    ) -> None:
        """Add the gradients that follow from `gradient` [z, y, x]; `means_too=False` leaves positions alone."""
        nz, ny, nx = self.shape
        padded = np.zeros((nz, ny, nx + lanes.WIDTH), np.float32)
        padded[:, :, :nx] = gradient
        _, scales, rotations, densities = self.parameters
        flat = padded.reshape(nz * ny, -1)
        _gather(
            self.table, self.boxes, self.hits, flat, ny, scales, rotations, densities, self.per_mm, means_too,
            d_means, d_log_scales, d_rotations, d_densities,
        )  # fmt: skip
