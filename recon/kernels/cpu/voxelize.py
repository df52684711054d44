"""Voxelisation of Gaussians on the CPU, slice by slice, because a slice of a Gaussian is a footprint (numba, threaded).

With the rows a, b, c (x, y, z) of R S in voxels, the exponent is a sum of squares without any subtraction of them:

    -2 E = k (δx - s δy - t δz)² + l (δy - r δz)² + δz² / Σzz
    Σzz = |c|²    l = Σzz / |b x c|²    k = |b x c|² / (s₁ s₂ s₃)²    r = b·c / Σzz    s = (a x c)·(b x c) / |b x c|²

At one δz this is a footprint in (x, y) whose centre has moved by δz (a·c, b·c) / Σzz, as in `cpu.project`.

A compact kernel is t^(3/2), t = 1 + 2 E / R². If t_z is t for δz alone, the slice at δz is the footprint of k / t_z and
l / t_z with weight t_z^(3/2).

The gradient needs per Gaussian N₀ = Σ g G, N₁ = Σ g D ε and N₂ = Σ g D εεᵀ with D as in `cpu.project` and
ε = (τ, δy', δz). δz is measured from the Gaussian's centre, τ and δy' from the centre of its footprint in the slice. In
the Gaussian's axes and standard deviations

    y = τ A + δy' B + δz C,   A = H e_x,   B = (c x A) sqrt(l) / |c x A|,   C = c / Σzz,   H = S⁻¹ Rᵀ per voxel

and with T = ρ Σ g D yyᵀ (see `cpu.footprints`)

    ∂ρ = N₀,   ∂p = ρ R S⁻¹ Σ g D y,   ∂ log scales and ∂R from T
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from recon.base.kernel import Kernel
from recon.kernels.cpu import lanes
from recon.kernels.cpu.activation import F32, OPTIONS
from recon.kernels.cpu.boxes import padded, padded_shape
from recon.kernels.cpu.footprints import HU, HV, KV, SHEAR, K, U, V, W, add_shape
from recon.kernels.cpu.project import COMPACT, GAUSSIAN, add_footprint, gather_footprint

_f = np.float32
# slices per task: the number is small, so that all threads have work on a 32-voxel cube, but large enough to keep rows
# in the cache
_SLAB = 4
_TASK = 1024  # Gaussians per task of the search
_SHARE = 16  # Gaussians per task of the backward pass
# Columns of the table, besides K, SHEAR and KV of the footprints. They are centre, shift of the centre per slice, 1 /
# Σzz, half widths of the middle slice over the reach, reach in standard deviations.
_X, _Y, _Z, _DRIFT_X, _DRIFT_Y, _KZ, _WIDE_X, _WIDE_Y, _REACH = 0, 1, 5, 6, 7, 8, 9, 10, 11
_FARTHEST = 1e30  # prevents infinity in float32
_PER = np.float32(1 / Kernel.COMPACT.radius**2)
_SLOPE = 8  # in a piece: the weight of D in a slice of a compact kernel


@njit(**OPTIONS)
def _near(
    means: F32, scales: F32, low: NDArray[np.float64], high: NDArray[np.float64], cut: float,
    indices: NDArray[np.int64], counts: NDArray[np.int64],
) -> None:  # fmt: skip
    """Gaussians whose bounding sphere meets the box low..high; each task fills its piece of `indices`."""
    n = means.shape[0]
    x0, y0, z0 = _f(low[0]), _f(low[1]), _f(low[2])
    x1, y1, z1 = _f(high[0]), _f(high[1]), _f(high[2])
    for task in prange(counts.shape[0]):
        begin = task * _TASK
        k = begin
        for i in range(begin, min(n, begin + _TASK)):
            reach = _f(cut) * max(scales[i, 0], scales[i, 1], scales[i, 2])
            x, y, z = means[i, 0], means[i, 1], means[i, 2]
            overlaps_xy = (x + reach >= x0) & (x - reach <= x1) & (y + reach >= y0) & (y - reach <= y1)
            indices[k] = i  # the next Gaussian overwrites this entry if this one is outside, so no branch is needed
            k += overlaps_xy & (z + reach >= z0) & (z - reach <= z1)
        counts[task] = k - begin


@njit(**OPTIONS)
def _place(
    near: NDArray[np.int64],
    means: F32,
    scales: F32,
    rotations: F32,
    densities: F32,
    origin: NDArray[np.float64],
    spacing: NDArray[np.float64],
    shape: tuple[int, int, int],
    faint: float,
    cut: float,
    ends: bool,
    table: F32,
    slices: NDArray[np.int32],
) -> None:
    """Fill table [k, 12] and slices [k, 2] (first, last + 1; 0, 0 outside the grid) of the Gaussians `near`.

    With `ends`, a kernel ends at `cut` by itself for any density.
    """
    nz, ny, nx = shape
    for j in prange(near.shape[0]):
        i = near[j]
        slices[j, 0] = slices[j, 1] = 0
        density = densities[i]
        if not density > _f(faint):
            continue
        reach = cut
        if faint > 0 and not ends:
            reach = min(cut, math.sqrt(2 * math.log(density / faint)))
        r, sc = rotations[i], scales[i]
        s0, s1, s2 = np.float64(sc[0]), np.float64(sc[1]), np.float64(sc[2])
        px, py, pz = 1 / spacing[2], 1 / spacing[1], 1 / spacing[0]
        a0, a1, a2 = px * r[0] * s0, px * r[1] * s1, px * r[2] * s2
        b0, b1, b2 = py * r[3] * s0, py * r[4] * s1, py * r[5] * s2
        c0, c1, c2 = pz * r[6] * s0, pz * r[7] * s1, pz * r[8] * s2
        x, y, z = px * (means[i, 0] - origin[0]), py * (means[i, 1] - origin[1]), pz * (means[i, 2] - origin[2])
        zz = c0 * c0 + c1 * c1 + c2 * c2
        half_x = reach * math.sqrt(a0 * a0 + a1 * a1 + a2 * a2)
        half_y = reach * math.sqrt(b0 * b0 + b1 * b1 + b2 * b2)
        half_z = reach * math.sqrt(zz)
        if not (x + half_x >= 0 and x - half_x <= nx - 1 and y + half_y >= 0 and y - half_y <= ny - 1):
            continue
        if not (z + half_z >= 0 and z - half_z <= nz - 1):
            continue
        slices[j, 0] = math.ceil(max(z - half_z, 0.0))
        slices[j, 1] = math.floor(min(z + half_z, nz - 1.0)) + 1
        ac0, ac1, ac2 = a1 * c2 - a2 * c1, a2 * c0 - a0 * c2, a0 * c1 - a1 * c0
        bc0, bc1, bc2 = b1 * c2 - b2 * c1, b2 * c0 - b0 * c2, b0 * c1 - b1 * c0
        aca = ac0 * ac0 + ac1 * ac1 + ac2 * ac2
        bcb = bc0 * bc0 + bc1 * bc1 + bc2 * bc2
        volume = s0 * s1 * s2 * px * py * pz
        table[j, _X], table[j, _Y], table[j, _Z] = x, y, z
        table[j, K] = min(bcb / (volume * volume), _FARTHEST)
        table[j, KV] = min(zz / bcb, _FARTHEST)
        table[j, _KZ] = min(1 / zz, _FARTHEST)
        table[j, SHEAR] = (ac0 * bc0 + ac1 * bc1 + ac2 * bc2) / bcb
        table[j, _DRIFT_X] = (a0 * c0 + a1 * c1 + a2 * c2) / zz
        table[j, _DRIFT_Y] = (b0 * c0 + b1 * c1 + b2 * c2) / zz
        table[j, _WIDE_X], table[j, _WIDE_Y] = math.sqrt(aca / zz), math.sqrt(bcb / zz)
        table[j, _REACH] = reach


@njit(inline="always", fastmath=True)
def _slice_footprint(table, j, z, weight, piece, profile):
    """Slice z of Gaussian j as a footprint, piece [1, 9 or more]; returns δz."""
    dz = _f(z) - table[j, _Z]
    square_z = table[j, _KZ] * dz * dz
    reach = np.sqrt(max(table[j, _REACH] * table[j, _REACH] - square_z, _f(0)))
    piece[0, U] = table[j, _X] + table[j, _DRIFT_X] * dz
    piece[0, V] = table[j, _Y] + table[j, _DRIFT_Y] * dz
    piece[0, HU], piece[0, HV] = reach * table[j, _WIDE_X], reach * table[j, _WIDE_Y]
    piece[0, SHEAR] = table[j, SHEAR]
    if profile is None:
        piece[0, K], piece[0, KV] = table[j, K], table[j, KV]
        # numba's own exp is a call that clears the vector registers.
        piece[0, W] = weight * lanes.lowest(lanes.exp(lanes.zero() + _f(-0.5) * square_z))
    else:
        remaining = max(_f(1) - _PER * square_z, _f(1e-7))
        piece[0, K], piece[0, KV] = table[j, K] / remaining, table[j, KV] / remaining
        piece[0, _SLOPE] = weight * np.sqrt(remaining)
        piece[0, W] = remaining * piece[0, _SLOPE]
    return dz


def _as_function(inlined: Any) -> Any:
    """A separate function, which LLVM copies into the loops. If numba copied it, it would be compiled several times."""
    plain = getattr(inlined, "py_func", inlined)  # with NUMBA_DISABLE_JIT it is already a plain function
    return njit(fastmath=True, error_model="numpy", forceinline=True)(plain)


_add_footprint, _gather_footprint = _as_function(add_footprint), _as_function(gather_footprint)


# The profile is a constant of the compiled kernels, as in `cpu.project`.
def _filler(profile: int | None) -> Any:
    @njit(**OPTIONS)
    def kernel(table: F32, slices: NDArray[np.int32], hits: NDArray[np.int64], densities: F32, volume: F32,
               ny: int, nx: int, pieces: F32) -> None:  # fmt: skip
        """volume [z, y, x] of padded slices.

        Each task fills `_SLAB` slices, so that no two tasks write to the same voxel.
        """
        for task in prange(pieces.shape[0]):
            low, high = task * _SLAB, min(volume.shape[0], (task + 1) * _SLAB)
            piece = pieces[task]
            volume[low:high] = _f(0)
            for j in range(hits.shape[0]):
                for z in range(max(low, slices[j, 0]), min(high, slices[j, 1])):
                    _slice_footprint(table, j, z, densities[hits[j]], piece, profile)
                    _add_footprint(piece, 0, ny, nx, volume[z], profile)

    return kernel


def _gatherer(profile: int | None) -> Any:
    @njit(**OPTIONS)
    def kernel(
        table: F32,
        slices: NDArray[np.int32],
        hits: NDArray[np.int64],
        gradient: F32,
        ny: int,
        nx: int,
        scales: F32,
        rotations: F32,
        densities: F32,
        spacing: NDArray[np.float64],
        means_too: bool,
        pieces: F32,
        d_means: F32,
        d_log_scales: F32,
        d_rotations: F32,
        d_densities: F32,
    ) -> None:
        ex, ez = _f(spacing[2]), _f(spacing[0])
        for task in prange(pieces.shape[0]):
            piece, slice_moments = pieces[task, :1], pieces[task, 1:]
            for j in range(task * _SHARE, min(hits.shape[0], (task + 1) * _SHARE)):
                i = hits[j]
                n0 = nt = nv = nz = tt = tv = vv = tz = vz = zz = _f(0)
                for z in range(slices[j, 0], slices[j, 1]):
                    dz = _slice_footprint(table, j, z, _f(1), piece, profile)
                    _gather_footprint(piece, 0, ny, nx, gradient[z], slice_moments, profile)
                    weight = piece[0, W]
                    m0 = weight * slice_moments[0, 0]
                    n0 += m0
                    if profile is not None:
                        weight = piece[0, _SLOPE]
                        m0 = weight * slice_moments[0, 6]
                    mt, mv = weight * slice_moments[0, 1], weight * slice_moments[0, 2]
                    nt, nv, nz = nt + mt, nv + mv, nz + dz * m0
                    tt, tv = tt + weight * slice_moments[0, 3], tv + weight * slice_moments[0, 4]
                    vv = vv + weight * slice_moments[0, 5]
                    tz, vz, zz = tz + dz * mt, vz + dz * mv, zz + dz * dz * m0
                density, r, s0, s1, s2 = densities[i], rotations[i], scales[i, 0], scales[i, 1], scales[i, 2]
                d_densities[i] += n0
                a0, a1, a2 = ex * r[0] / s0, ex * r[1] / s1, ex * r[2] / s2
                c0, c1, c2 = r[6] * s0 / ez, r[7] * s1 / ez, r[8] * s2 / ez
                # Scale B to its length sqrt(l), which removes the rounding errors of its factors.
                b0, b1, b2 = c1 * a2 - c2 * a1, c2 * a0 - c0 * a2, c0 * a1 - c1 * a0
                size = np.sqrt(table[j, KV] / max(b0 * b0 + b1 * b1 + b2 * b2, _f(1 / _FARTHEST)))
                b0, b1, b2 = size * b0, size * b1, size * b2
                c0, c1, c2 = table[j, _KZ] * c0, table[j, _KZ] * c1, table[j, _KZ] * c2
                if means_too:
                    y0 = density * (nt * a0 + nv * b0 + nz * c0) / s0
                    y1 = density * (nt * a1 + nv * b1 + nz * c1) / s1
                    y2 = density * (nt * a2 + nv * b2 + nz * c2) / s2
                    d_means[i, 0] += r[0] * y0 + r[1] * y1 + r[2] * y2
                    d_means[i, 1] += r[3] * y0 + r[4] * y1 + r[5] * y2
                    d_means[i, 2] += r[6] * y0 + r[7] * y1 + r[8] * y2
                # T / ρ = (τ A + δv B + δz C)(...)ᵀ, as A fᵀ + B gᵀ + C hᵀ.
                f0, f1, f2 = tt * a0 + tv * b0 + tz * c0, tt * a1 + tv * b1 + tz * c1, tt * a2 + tv * b2 + tz * c2
                g0, g1, g2 = tv * a0 + vv * b0 + vz * c0, tv * a1 + vv * b1 + vz * c1, tv * a2 + vv * b2 + vz * c2
                h0, h1, h2 = tz * a0 + vz * b0 + zz * c0, tz * a1 + vz * b1 + zz * c1, tz * a2 + vz * b2 + zz * c2
                add_shape(
                    i, scales, rotations,
                    density * (a0 * f0 + b0 * g0 + c0 * h0), density * (a0 * f1 + b0 * g1 + c0 * h1),
                    density * (a0 * f2 + b0 * g2 + c0 * h2), density * (a1 * f1 + b1 * g1 + c1 * h1),
                    density * (a1 * f2 + b1 * g2 + c1 * h2), density * (a2 * f2 + b2 * g2 + c2 * h2),
                    d_log_scales, d_rotations,
                )  # fmt: skip

    return kernel


_PROFILES = {Kernel.GAUSSIAN: GAUSSIAN, Kernel.COMPACT: COMPACT}
_FILL = {kernel: _filler(profile) for kernel, profile in _PROFILES.items()}
_GATHER = {kernel: _gatherer(profile) for kernel, profile in _PROFILES.items()}


class Layout:
    """Gaussians placed on one grid, with the forward and the backward pass."""

    def __init__(
        self,
        parameters: tuple[F32, F32, F32, F32],
        origin: tuple[float, float, float],
        spacing: float | tuple[float, float, float],
        shape: tuple[int, int, int],
        faint: float,
        cut: float,
        kernel: Kernel = Kernel.GAUSSIAN,
    ) -> None:
        """`parameters` are means [n, 3] mm, standard deviations [n, 3] mm, rotations [n, 9] and densities [n].

        `origin` is the centre (x, y, z) of voxel [0, 0, 0] in mm, `spacing` the voxels' edge or edges (z, y, x).

        Gaussians are cut off where they fall below `faint` (a density). They are also cut off at `cut` standard
        deviations; compact kernels at their own end, if they are above `faint` anywhere.
        """
        means, scales, _, densities = parameters
        n, cut = densities.shape[0], kernel.reach(cut)
        self.parameters, self.shape, self._kernel = parameters, shape, kernel
        self._spacing = np.broadcast_to(np.asarray(spacing, np.float64), 3).copy()
        corner = np.asarray(origin, np.float64)
        edge = self._spacing[::-1]
        indices, counts = np.empty(n, np.int64), np.empty(-(-n // _TASK), np.int64)
        # Half a voxel more on all sides, because the search rounds to float32.
        _near(means, scales, corner - edge / 2, corner + (np.asarray(shape[::-1]) - 0.5) * edge, cut, indices, counts)
        pieces = [indices[k * _TASK : k * _TASK + count] for k, count in enumerate(counts)]
        near = np.concatenate(pieces) if pieces else indices
        table, slices = np.empty((near.size, 12), np.float32), np.empty((near.size, 2), np.int32)
        _place(near, *self.parameters, corner, self._spacing, shape, faint, cut, kernel.is_compact, table, slices)
        meets_grid = slices[:, 1] > slices[:, 0]
        self.hits, self._table, self._slices = near[meets_grid], table[meets_grid], slices[meets_grid]

    def fill(self) -> F32:
        """Density [z, y, x] at the voxel centres."""
        nz, ny, nx = self.shape
        volume = np.empty((nz, *padded_shape(ny, nx)), np.float32)
        pieces = np.empty((-(-nz // _SLAB), 1, 16), np.float32)
        _FILL[self._kernel](self._table, self._slices, self.hits, self.parameters[3], volume, ny, nx, pieces)
        return volume[:, :ny, :nx]

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
        """Back-propagate `gradient` [z, y, x], adding to the other gradients; `means_too=False`: not to positions."""
        _, ny, nx = self.shape
        _, scales, rotations, densities = self.parameters
        pieces = np.empty((-(-self.hits.size // _SHARE), 2, 16), np.float32)
        _GATHER[self._kernel](
            self._table, self._slices, self.hits, padded(gradient), ny, nx, scales, rotations, densities,
            self._spacing, means_too, pieces, d_means, d_log_scales, d_rotations, d_densities,
        )  # fmt: skip
