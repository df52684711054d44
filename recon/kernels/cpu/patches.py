"""Patches on the CPU: the mean of all 4 x 4 x 4 blocks of a volume without small cosine coefficients (numba, threaded).

    D(x) = 1/64 Σ Rᵀ T⁻¹ H(T R x)        R: a block, T: its orthonormal cosine transform, H: keeps |c| > threshold, c₀

over all blocks that overlap the volume, which is mirrored at its faces. The transform of a plane of a block serves the
four blocks that share this plane, and their inverse transforms are added before that of the plane.

A volume is [a, b, c]; blocks are 4 x 4 x 1 if it has fewer than four voxels along c. Sixteen neighbouring blocks of a
plane [b c] are one vector. Blocks beyond the end of a line along c are computed with weight 0.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange

from recon.kernels.cpu import lanes
from recon.kernels.cpu.activation import F32, OPTIONS

EDGE = 4
"""Voxels of a block along an axis."""

_f = np.float32
_BEYOND = EDGE - 1  # number of voxels that blocks reach beyond a face
_HALF, _LONG, _SHORT = _f(0.5), _f(math.cos(math.pi / 8) / math.sqrt(2)), _f(math.sin(math.pi / 8) / math.sqrt(2))
_TASKS, _LEAST, _MOST = 32, 4, 32  # approximate number of tasks; planes of one task


class PatchScratch(NamedTuple):
    """Memory for the volume extended beyond its faces, and for sums of blocks; see `patch_scratch`.

    Attributes:
        extended, sums: [a + 6, plane], planes of (b + 6) lines and room for the last vector.
        share: [1, plane], weight of a block at each position: 1 / 64 (1 / 16 for a flat block), or 0.
    """

    extended: F32
    sums: F32
    share: F32


@njit(inline="always", fastmath=True)
def _cosines(p, base, step):
    """Sixteen vectors' cosine coefficients along one axis, in place: rows base + 0 ... 3 step of p."""
    a, b = lanes.load(p, base, 0), lanes.load(p, base + step, 0)
    c, d = lanes.load(p, base + 2 * step, 0), lanes.load(p, base + 3 * step, 0)
    outer, inner, wide, near = a + d, b + c, a - d, b - c
    lanes.store(p, base, 0, (outer + inner) * _HALF)
    lanes.store(p, base + step, 0, wide * _LONG + near * _SHORT)
    lanes.store(p, base + 2 * step, 0, (outer - inner) * _HALF)
    lanes.store(p, base + 3 * step, 0, wide * _SHORT - near * _LONG)


@njit(inline="always", fastmath=True)
def _inverse_cosines(p, base, step):
    """The inverse of `_cosines`."""
    a, b = lanes.load(p, base, 0) * _HALF, lanes.load(p, base + step, 0)
    c, d = lanes.load(p, base + 2 * step, 0) * _HALF, lanes.load(p, base + 3 * step, 0)
    outer, inner, wide, near = a + c, a - c, b * _LONG + d * _SHORT, b * _SHORT - d * _LONG
    lanes.store(p, base, 0, outer + wide)
    lanes.store(p, base + step, 0, inner + near)
    lanes.store(p, base + 2 * step, 0, inner - near)
    lanes.store(p, base + 3 * step, 0, outer - wide)


@njit(inline="always", fastmath=True)
def _shrink(coefficients, sums, size, plane, threshold):
    """Adds the blocks whose first plane is `plane`, `coefficients` [4 size, 16], to `sums`.

    Both use the plane modulo 4.
    """
    p0, p1, p2, p3 = (plane & 3) * size, (plane + 1 & 3) * size, (plane + 2 & 3) * size, (plane + 3 & 3) * size
    for m in range(size):
        a, b, c, d = (
            lanes.load(coefficients, p0 + m, 0), lanes.load(coefficients, p1 + m, 0),
            lanes.load(coefficients, p2 + m, 0), lanes.load(coefficients, p3 + m, 0),
        )  # fmt: skip
        outer, inner, wide, near = a + d, b + c, a - d, b - c
        mean = (outer + inner) * _HALF
        if m > 0:
            mean = lanes.larger(mean, threshold)
        a = mean * _HALF
        b = lanes.larger(wide * _LONG + near * _SHORT, threshold)
        c = lanes.larger((outer - inner) * _HALF, threshold) * _HALF
        d = lanes.larger(wide * _SHORT - near * _LONG, threshold)
        outer, inner, wide, near = a + c, a - c, b * _LONG + d * _SHORT, b * _SHORT - d * _LONG
        lanes.store(sums, p0 + m, 0, lanes.load(sums, p0 + m, 0) + (outer + wide))
        lanes.store(sums, p1 + m, 0, lanes.load(sums, p1 + m, 0) + (inner + near))
        lanes.store(sums, p2 + m, 0, lanes.load(sums, p2 + m, 0) + (inner - near))
        lanes.store(sums, p3 + m, 0, lanes.load(sums, p3 + m, 0) + (outer - wide))


@njit(fastmath=True, error_model="numpy", cache=True)
def _column(extended, out, share, first, end, position, line, depth, threshold, coefficients, sums):
    """Sixteen columns of blocks, with first voxels in planes `first` to `end`; `position`: place of the first
    column in a plane."""
    size = EDGE * depth
    weights = lanes.load(share, 0, position)
    for m in range(EDGE * size):
        lanes.store(sums, m, 0, lanes.zero())
    for plane in range(first, end + 2 * _BEYOND):
        slot = (plane & 3) * size
        if plane < end + _BEYOND:
            for j in range(EDGE):
                for k in range(depth):
                    lanes.store(
                        coefficients, slot + j * depth + k, 0, lanes.load(extended, plane, position + j * line + k)
                    )
            if depth > 1:
                for j in range(EDGE):
                    _cosines(coefficients, slot + j * depth, 1)
            for k in range(depth):
                _cosines(coefficients, slot + k, depth)
        finished = plane - _BEYOND
        if finished < first:
            continue
        if finished < end:
            _shrink(coefficients, sums, size, finished, threshold)
        slot = (finished & 3) * size
        for k in range(depth):
            _inverse_cosines(sums, slot + k, depth)
        if depth > 1:
            for j in range(EDGE):
                _inverse_cosines(sums, slot + j * depth, 1)
        # The last voxel of a block comes first, so that a voxel sums its blocks in the same order, whatever the first
        # voxel of a vector.
        for j in range(EDGE - 1, -1, -1):
            for k in range(depth - 1, -1, -1):
                target, row = position + j * line + k, slot + j * depth + k
                lanes.store(
                    out, finished, target, lanes.load(out, finished, target) + lanes.load(sums, row, 0) * weights
                )
                lanes.store(sums, row, 0, lanes.zero())


@njit(**OPTIONS)
def _denoise(
    extended: F32, sums: F32, share: F32, blocks: int, line: int, depth: int, threshold: float, step: int
) -> None:
    planes, size = extended.shape[0] - _BEYOND, EDGE * EDGE * depth
    tasks = -(-planes // step)
    for parity in range(2):  # neighbouring tasks add to the same planes
        for half in prange((tasks + 1 - parity) // 2):
            first = (2 * half + parity) * step
            end = min(first + step, planes)
            coefficients, block_sums = np.empty((size, 16), np.float32), np.empty((size, 16), np.float32)
            for position in range(0, blocks, 16):
                _column(
                    extended, sums, share, first, end, position, line, depth, _f(threshold), coefficients, block_sums
                )


@njit(inline="always")
def _mirrored(i, n):
    i %= 2 * n
    return i if i < n else 2 * n - 1 - i


@njit(**OPTIONS)
def _pad(x: F32, beyond: int, extended: F32, sums: F32) -> None:
    na, nb, nc = x.shape
    line = nc + 2 * beyond
    for p in prange(na + 2 * _BEYOND):
        sums[p] = _f(0)
        i = _mirrored(p - _BEYOND, na)
        for q in range(nb + 2 * _BEYOND):
            source, target = x[i, _mirrored(q - _BEYOND, nb)], extended[p, q * line : (q + 1) * line]
            for k in range(nc):
                target[beyond + k] = source[k]
            for k in range(beyond):
                target[k], target[line - 1 - k] = source[beyond - 1 - k], source[nc - beyond + k]


@njit(**OPTIONS)
def _crop(sums: F32, beyond: int, floor: float, out: F32) -> None:
    na, nb, nc = out.shape
    line, low = nc + 2 * beyond, _f(floor)
    for i in prange(na):
        for j in range(nb):
            start = (j + _BEYOND) * line + beyond
            source, target = sums[i + _BEYOND, start : start + nc], out[i, j]
            for k in range(nc):
                target[k] = max(source[k], low)


def patch_scratch(shape: tuple[int, int, int]) -> PatchScratch:
    """Scratch of `denoise` for volumes [a, b, c] of this shape; see `scratch_values`."""
    na, nb, nc = shape
    depth, beyond = _depth(nc)
    line = nc + 2 * beyond
    blocks = _rounded_up((nb + _BEYOND) * line)
    size = blocks + _BEYOND * line + 16
    weights_of_plane = np.zeros((nb + 2 * _BEYOND, line), np.float32)
    weights_of_plane[: nb + _BEYOND, : nc + beyond] = 1 / (EDGE**2 * depth)
    weights = np.zeros((1, size), np.float32)
    weights[0, : weights_of_plane.size] = weights_of_plane.ravel()
    extended, sums = (np.zeros((na + 2 * _BEYOND, size), np.float32) for _ in range(2))
    return PatchScratch(extended, sums, weights)


def scratch_values(shape: tuple[int, int, int]) -> int:
    """Number of values in `patch_scratch`."""
    na, nb, nc = shape
    line = nc + 2 * _depth(nc)[1]
    return (2 * (na + 2 * _BEYOND) + 1) * (_rounded_up((nb + _BEYOND) * line) + _BEYOND * line + 16)


def _depth(nc: int) -> tuple[int, int]:
    """Number of voxels of a block along c, and beyond the faces."""
    return (EDGE, _BEYOND) if nc >= EDGE else (1, 0)


def _rounded_up(values: int) -> int:
    return -(-values // 16) * 16


def denoise(x: F32, threshold: float, nonnegative: bool, scratch: PatchScratch, out: F32) -> None:
    """out = D(x), at least 0 with `nonnegative`; `out` may be `x`.

    The result is bit-identical for any number of threads.

    Args:
        x: [a, b, c].
        threshold: threshold for coefficients, in the unit of x; white noise with standard deviation σ has coefficients
            with standard deviation σ.
    """
    na, nb, nc = x.shape
    depth, beyond = _depth(nc)
    line = nc + 2 * beyond
    _pad(x, beyond, scratch.extended, scratch.sums)
    step = min(max(na // _TASKS, _LEAST), _MOST)
    _denoise(*scratch, (nb + _BEYOND) * line, line, depth, threshold, step)
    _crop(scratch.sums, beyond, 0.0 if nonnegative else float(np.finfo(np.float32).min), out)


@njit(**OPTIONS)
def _pulled_step(
    x: F32, change: F32, momentum: float, step_size: float, gradient: F32, pull: float, z: F32, floor: float
) -> None:  # fmt: skip
    p, q, m, low = _f(momentum), _f(step_size), _f(pull), _f(floor)
    for i in prange(x.size):
        value = x[i]
        x[i] = max(value + p * change[i] + q * (gradient[i] + m * (z[i] - value)), low)
        change[i] = x[i] - value


def pulled_step(
    x: F32, change: F32, momentum: float, step_size: float, gradient: F32, pull: float, z: F32, nonnegative: bool
) -> None:  # fmt: skip
    """change = momentum change + step_size (gradient + pull (z - x)), x += change, at least 0 with `nonnegative`."""
    floor = 0.0 if nonnegative else float(np.finfo(np.float32).min)
    _pulled_step(
        x.reshape(-1), change.reshape(-1), momentum, step_size, gradient.reshape(-1), pull, z.reshape(-1), floor
    )
