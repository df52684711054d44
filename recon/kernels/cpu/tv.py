"""Total variation on the CPU: a step of the dual denoising problem, and the gradient of smoothed TV (numba, threaded).

    TV(x) = Σ |D x|,   (D x)_a = w_a (x[i + 1] - x[i]) along axis a, zero at the end;   w: for voxels that are not cubes

Volumes are [a, b, c]; a dual field has three of them. Each thread processes a run of planes and keeps two of them in
its cache, so that a step reads and writes every array once.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import get_num_threads, njit, prange
from numpy.typing import NDArray

from recon.kernels.cpu.activation import F32, OPTIONS

_f = np.float32
_NO_FLOOR = -3.0e38
_FASTEST = 1e15  # largest pace; squares of the dual fields stay within float32, and one step saturates any difference
_APART = 17 * 16  # values, 17 cache lines
_PIECE = 512  # approximate number of voxels of one loop
Weights = tuple[float, float, float]
DualField = tuple[F32, F32, F32]


class DualScratch(NamedTuple):
    """Planes of the primal point, for each run of planes that one thread processes.

    Attributes:
        plane: [run, b c + 1], the first plane. The value after the last voxel is read and multiplied by 0, so it must
            be finite.
        planes: [run, 2, b c + 1], the present plane and the next one.
        zero: [b c], the differences before the first plane.
    """

    plane: F32
    planes: F32
    zero: F32


# The kernels process planes [b c] in pieces of several rows, because for rows of sixteen voxels, the start of a loop
# takes longer than the loop. Fields must be zero where there is no difference: in the last plane of pa, row of pb and
# column of pc.


@njit(fastmath=True, error_model="numpy", cache=True)
def _primal_plane(x, pa, pb, pc, i, nc, threshold, w0, w1, w2, floor, zero, out):
    """Plane i of max(x - threshold Dᵀ p, floor) into the first b c values of `out`."""
    size = x.shape[1]
    here, p0, p1, p2 = x[i], pa[i], pb[i], pc[i]
    before0 = pa[i - 1] if i > 0 else zero
    out[0] = max(here[0] - threshold * (w0 * (before0[0] - p0[0]) - w1 * p1[0] - w2 * p2[0]), floor)
    step = max(1, _PIECE // nc) * nc
    end = 1
    while end < size:
        start, end = end, nc if end < nc else min(end + step, size)
        h, q0, q1, q2, row = here[start:end], p0[start:end], p1[start:end], p2[start:end], out[start:end]
        b0, b2 = before0[start:end], p2[start - 1 : end - 1]
        b1 = zero[start:end] if start < nc else p1[start - nc : end - nc]
        for k in range(h.size):
            pull = w0 * (b0[k] - q0[k]) + w1 * (b1[k] - q1[k]) + w2 * (b2[k] - q2[k])
            row[k] = max(h[k] - threshold * pull, floor)


@njit(inline="always")
def _dual_piece(p0, p1, p2, near0, far0, near1, far1, here, after, s0, s1, s2):
    """The differences of one piece of a plane; s2 [k] is 0 for the last of each row."""
    for k in range(p0.size):
        q0 = p0[k] + s0 * (far0[k] - near0[k])
        q1 = p1[k] + s1 * (far1[k] - near1[k])
        q2 = p2[k] + s2[k] * (after[k] - here[k])
        shrink = _f(1) / max(_f(1), np.sqrt(q0 * q0 + q1 * q1 + q2 * q2))
        p0[k], p1[k], p2[k] = q0 * shrink, q1 * shrink, q2 * shrink


@njit(fastmath=True, error_model="numpy", cache=True)
def _dual_plane(pa, pb, pc, v, pair, nc, near, far, here, back1, s0, s1, s2):
    """The differences that belong to the voxels of plane v: from u `near` to `far` at `pair`, and within `here`."""
    p0, p1, p2, last, back = pa[pair], pb[v], pc[v], pa.shape[1] - nc, back1 * nc
    # The difference from the last row is 0 and remains 0. It belongs to the last row or, with back1, to the first row.
    first = 0 if back1 else last
    row, after, low = slice(first, first + nc), slice(first + 1, first + nc + 1), slice(last, last + nc)
    u = here[low]
    _dual_piece(p0[row], p1[low], p2[row], near[row], far[row], u, u, here[row], here[after], s0, s1, s2)
    for start in range(0, last, s2.size):  # pieces of the other differences, from rows `low` to rows `high`
        end = min(start + s2.size, last)
        low, high = slice(start, end), slice(start + nc, end + nc)
        own, after = slice(start + back, end + back), slice(start + back + 1, end + back + 1)
        _dual_piece(
            p0[own], p1[low], p2[own], near[own], far[own], here[low], here[high], here[own], here[after], s0, s1, s2
        )


@njit(**OPTIONS)
def _dual_step(
    x: F32, pa: F32, pb: F32, pc: F32, nc: int, threshold: float, step_size: float, weights: Weights, floor: float,
    back0: int, back1: int, edges: F32, planes: F32, zero: F32,
) -> None:  # fmt: skip
    na, runs = x.shape[0], edges.shape[0]
    w0, w1, w2 = _f(weights[0]), _f(weights[1]), _f(weights[2])
    s0, s1 = _f(step_size) * w0, _f(step_size) * w1
    s2 = np.full(max(1, _PIECE // nc) * nc, _f(step_size) * w2)
    s2[nc - 1 :: nc] = _f(0)
    # Compute the first plane of each run, before another thread changes the dual fields on which this plane depends.
    for run in prange(runs):
        _primal_plane(x, pa, pb, pc, run * na // runs, nc, _f(threshold), w0, w1, w2, _f(floor), zero, edges[run])
    for run in prange(runs):
        first, last = run * na // runs, (run + 1) * na // runs
        if back0 and run == 0:  # before the first plane there is no difference
            start = edges[0]
            _dual_plane(pa, pb, pc, 0, na - 1, nc, start, start, start, back1, s0, s1, s2)
        for i in range(first, last):
            here = edges[run] if i == first else planes[run, i % 2]
            if i + 1 < last:
                after = planes[run, (i + 1) % 2]
                _primal_plane(x, pa, pb, pc, i + 1, nc, _f(threshold), w0, w1, w2, _f(floor), zero, after)
            else:
                after = edges[run + 1] if run + 1 < runs else here
            if not back0:
                _dual_plane(pa, pb, pc, i, i, nc, here, after, here, back1, s0, s1, s2)
            elif i + 1 < na:
                _dual_plane(pa, pb, pc, i + 1, i, nc, here, after, after, back1, s0, s1, s2)


@njit(**OPTIONS)
def _primal(
    x: F32, pa: F32, pb: F32, pc: F32, nc: int, threshold: float, weights: Weights, floor: float,
    planes: F32, zero: F32, out: F32,
) -> None:  # fmt: skip
    na, size = x.shape
    w0, w1, w2 = _f(weights[0]), _f(weights[1]), _f(weights[2])
    runs = planes.shape[0]
    for run in prange(runs):
        plane = planes[run, 0]
        for i in range(run * na // runs, (run + 1) * na // runs):
            _primal_plane(x, pa, pb, pc, i, nc, _f(threshold), w0, w1, w2, _f(floor), zero, plane)
            target = out[i]
            for k in range(size):
                target[k] = plane[k]


def dual_step_size(threshold: float, weights: Weights) -> float:
    """The length of a dual step: 0.75 of the longest step that converges by itself, see `dual_step`."""
    return min(1.5 / (4 * sum(w * w for w in weights)) / threshold, _FASTEST)


def dual_step(
    x: F32, p: DualField, threshold: float, weights: Weights, nonnegative: bool, scratch: DualScratch,
    back: tuple[int, int] = (0, 0),
) -> None:  # fmt: skip
    """p <- projection onto |p| <= 1 of p + step_size D P(x - threshold Dᵀ p), in place; P clips negative values or
    none.

    Projected gradient ascent of the dual of min ½|y - x|² + threshold TV(y) (Chambolle 2004; with P: Beck & Teboulle
    2009, eq. 4.6), at 0.75 of the longest step that converges by itself. With longer steps, the sign of the finest
    differences alternates from step to step, and an outer iteration with momentum amplifies them.

    Args:
        scratch: see `dual_scratch`.
        back: for the first two axes, 1: |p| of a voxel uses the difference from the previous voxel; 0: the difference
            to the next voxel. This is total variation in a mirror image.
    """
    step_size = dual_step_size(threshold, weights)
    floor = 0.0 if nonnegative else _NO_FLOOR
    _dual_step(*_in_planes(x, *p), x.shape[2], threshold, step_size, weights, floor, *back, *scratch)


def primal(
    x: F32, p: DualField, threshold: float, weights: Weights, nonnegative: bool, scratch: DualScratch, out: F32
) -> None:
    """out = P(x - threshold Dᵀ p); `out` may be `x`."""
    assert out.flags.c_contiguous
    floor, (to,) = 0.0 if nonnegative else _NO_FLOOR, _in_planes(out)
    _primal(*_in_planes(x, *p), x.shape[2], threshold, weights, floor, scratch.planes, scratch.zero, to)


def _in_planes(*arrays: F32) -> list[F32]:
    return [array.reshape(len(array), -1) for array in arrays]


def dual_field(shape: tuple[int, int, int]) -> DualField:
    """Zeros [a, b, c] for the differences along each axis; element i is the difference from i to i + 1.

    Each array begins some cache lines after a multiple of its size. Fields at a distance of a power of two would share
    one set of the cache, and a step of 1024 x 1024 x 64 voxels would take three times as long.
    """
    size = math.prod(shape)
    room = np.zeros(3 * (size + _APART), np.float32)
    a, b, c = (room[at : at + size].reshape(shape) for at in (n * (size + _APART) for n in range(3)))
    return a, b, c


def dual_scratch(shape: tuple[int, int, int]) -> DualScratch:
    """Scratch for `dual_step` and `primal`.

    They are separate arrays without gaps. For parts of one array, the compiler would make code that gathers single
    numbers, which takes three times as long.
    """
    runs, (_, b, c) = _runs(shape), shape
    shapes = (runs, b * c + 1), (runs, 2, b * c + 1), (b * c,)
    return DualScratch(*(np.zeros(shape, np.float32) for shape in shapes))


def _runs(shape: tuple[int, int, int]) -> int:
    return min(shape[0], 2 * get_num_threads())


@njit(**OPTIONS)
def _gradient(x: F32, smoothing: float, weights: Weights, fields: F32, out: F32, sums: NDArray[np.float64]) -> None:
    na, nb, nc = x.shape
    runs = fields.shape[0]
    w0, w1, w2 = _f(weights[0]), _f(weights[1]), _f(weights[2])
    tiny = _f(smoothing * smoothing)
    for run in prange(runs):
        first, last = run * na // runs, (run + 1) * na // runs
        total = 0.0
        if first == 0:
            fields[run, 1, 0] = _f(0)  # plane -1
        for i in range(max(0, first - 1), last):
            now, before = fields[run, i % 2], fields[run, (i + 1) % 2]
            for j in range(nb):
                row, next_plane, next_row = x[i, j], x[min(i + 1, na - 1), j], x[i, min(j + 1, nb - 1)]
                n0, n1, n2 = now[0, j], now[1, j], now[2, j]
                for k in range(nc - 1):
                    d0, d1, d2 = w0 * (next_plane[k] - row[k]), w1 * (next_row[k] - row[k]), w2 * (row[k + 1] - row[k])
                    scale = _f(1) / np.sqrt(d0 * d0 + d1 * d1 + d2 * d2 + tiny)
                    n0[k], n1[k], n2[k] = d0 * scale, d1 * scale, d2 * scale
                d0, d1 = w0 * (next_plane[nc - 1] - row[nc - 1]), w1 * (next_row[nc - 1] - row[nc - 1])
                scale = _f(1) / np.sqrt(d0 * d0 + d1 * d1 + tiny)
                n0[nc - 1], n1[nc - 1], n2[nc - 1] = d0 * scale, d1 * scale, _f(0)
            if i < first:
                continue
            for j in range(nb):
                target = out[i, j]
                n0, n1, n2, b0 = now[0, j], now[1, j], now[2, j], before[0, j]
                b1 = now[1, max(j - 1, 0)]
                inner = w1 if j > 0 else _f(0)
                target[0] = w0 * (b0[0] - n0[0]) + inner * b1[0] - w1 * n1[0] - w2 * n2[0]
                part = target[0] * target[0]
                for k in range(1, nc):
                    value = w0 * (b0[k] - n0[k]) + inner * b1[k] - w1 * n1[k] + w2 * (n2[k - 1] - n2[k])
                    target[k] = value
                    part += value * value
                total += part
        sums[run] = total


@njit(**OPTIONS)
def _total_variation(x: F32, weights: Weights, sums: NDArray[np.float64]) -> None:
    na, nb, nc = x.shape
    w0, w1, w2 = _f(weights[0]), _f(weights[1]), _f(weights[2])
    for i in prange(na):
        total = np.float64(0)
        for j in range(nb):
            row, next_plane, next_row = x[i, j], x[min(i + 1, na - 1), j], x[i, min(j + 1, nb - 1)]
            line = _f(0)
            for k in range(nc):
                d0, d1, d2 = next_plane[k] - row[k], next_row[k] - row[k], row[min(k + 1, nc - 1)] - row[k]
                line += np.sqrt((w0 * d0) ** 2 + (w1 * d1) ** 2 + (w2 * d2) ** 2)
            total += np.float64(line)
        sums[i] = total


def total_variation(x: F32, weights: Weights) -> float:
    """Σ |D x| of x [a, b, c]."""
    sums = np.empty(x.shape[0], np.float64)
    _total_variation(x, weights, sums)
    return float(sums.sum())


def gradient(x: F32, smoothing: float, weights: Weights, out: F32) -> float:
    """Gradient of Σ sqrt(|D x|² + smoothing²) into `out`; returns its 2-norm.

    Args:
        x: [a, b, c].
        smoothing: positive, in the unit of x; without it the gradient is not defined where x is constant.
    """
    fields = np.empty((_runs(x.shape), 2, 3, *x.shape[1:]), np.float32)
    sums = np.empty(fields.shape[0], np.float64)
    _gradient(x, smoothing, weights, fields, out, sums)
    return math.sqrt(float(sums.sum()))
