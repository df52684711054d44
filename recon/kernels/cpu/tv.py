"""Total variation on the CPU: a step of the dual denoising problem, and the gradient of smoothed TV (numba, threaded).

    TV(x) = Σ |D x|,   (D x)_a = w_a (x[i + 1] - x[i]) along axis a, zero at the end;   w: for voxels that are not cubes

Volumes are [a, b, c], dual fields three of them. Each thread takes a run of planes and keeps two of them in its cache,
so a step reads and writes every array once.
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
_APART = 17 * 16  # values: 17 lines of the cache
Weights = tuple[float, float, float]
DualField = tuple[F32, F32, F32]


class DualScratch(NamedTuple):
    """One plane [run, b, c + 1], and two [run, 2, b, c + 1], for each run of planes that one thread makes."""

    plane: F32
    planes: F32


@njit(fastmath=True, error_model="numpy", cache=True)
def _primal_plane(x, pa, pb, pc, i, threshold, w0, w1, w2, floor, zero, out):
    """Plane i of max(x - threshold Dᵀ p, floor) into out [b, c + 1]; the last column is repeated."""
    nb, nc = x.shape[1], x.shape[2]
    for j in range(nb):
        here, row = x[i, j], out[j]
        p0, p1, p2 = pa[i, j], pb[i, j], pc[i, j]
        before0 = pa[i - 1, j] if i > 0 else zero
        before1 = pb[i, j - 1] if j > 0 else zero
        row[0] = max(here[0] - threshold * (w0 * (before0[0] - p0[0]) + w1 * (before1[0] - p1[0]) - w2 * p2[0]), floor)
        for k in range(1, nc):
            pull = w0 * (before0[k] - p0[k]) + w1 * (before1[k] - p1[k]) + w2 * (p2[k - 1] - p2[k])
            row[k] = max(here[k] - threshold * pull, floor)
        row[nc] = row[nc - 1]


@njit(fastmath=True, error_model="numpy", cache=True)
def _dual_plane(pa, pb, pc, v, pair, near, far, here, back1, s0, s1, s2):
    """The differences that belong to the voxels of plane v: from u `near` to `far` at `pair`, and within `here`."""
    nb, nc = pb.shape[1], pb.shape[2]
    for j in range(nb):
        start = j - back1 if j >= back1 else nb - 1  # from the last row there is no difference: 0, and stays so
        row, near0, far0, near1, far1 = here[j], near[j], far[j], here[start], here[min(start + 1, nb - 1)]
        p0, p1, p2 = pa[pair, j], pb[v, start], pc[v, j]
        for k in range(nc):
            q0 = p0[k] + s0 * (far0[k] - near0[k])
            q1 = p1[k] + s1 * (far1[k] - near1[k])
            q2 = p2[k] + s2 * (row[k + 1] - row[k])
            shrink = _f(1) / max(_f(1), np.sqrt(q0 * q0 + q1 * q1 + q2 * q2))
            p0[k], p1[k], p2[k] = q0 * shrink, q1 * shrink, q2 * shrink


@njit(**OPTIONS)
def _dual_step(
    x: F32, pa: F32, pb: F32, pc: F32, threshold: float, pace: float, weights: Weights, floor: float,
    back0: int, back1: int, edges: F32, planes: F32,
) -> None:  # fmt: skip
    na, _, nc = x.shape
    runs = edges.shape[0]
    w0, w1, w2 = _f(weights[0]), _f(weights[1]), _f(weights[2])
    zero = np.zeros(nc, np.float32)
    # The first plane of each run, before another thread changes the dual fields that it depends on.
    for run in prange(runs):
        _primal_plane(x, pa, pb, pc, run * na // runs, _f(threshold), w0, w1, w2, _f(floor), zero, edges[run])
    for run in prange(runs):
        first, last = run * na // runs, (run + 1) * na // runs
        s0, s1, s2 = _f(pace) * w0, _f(pace) * w1, _f(pace) * w2
        if back0 and run == 0:  # before the first plane there is no difference
            start = edges[0]
            _dual_plane(pa, pb, pc, 0, na - 1, start, start, start, back1, s0, s1, s2)
        for i in range(first, last):
            here = edges[run] if i == first else planes[run, i % 2]
            if i + 1 < last:
                after = planes[run, (i + 1) % 2]
                _primal_plane(x, pa, pb, pc, i + 1, _f(threshold), w0, w1, w2, _f(floor), zero, after)
            else:
                after = edges[run + 1] if run + 1 < runs else here
            if not back0:
                _dual_plane(pa, pb, pc, i, i, here, after, here, back1, s0, s1, s2)
            elif i + 1 < na:
                _dual_plane(pa, pb, pc, i + 1, i, here, after, after, back1, s0, s1, s2)


@njit(**OPTIONS)
def _primal(
    x: F32, pa: F32, pb: F32, pc: F32, threshold: float, weights: Weights, floor: float, planes: F32, out: F32
) -> None:
    na, nb, nc = x.shape
    w0, w1, w2 = _f(weights[0]), _f(weights[1]), _f(weights[2])
    zero = np.zeros(nc, np.float32)
    runs = planes.shape[0]
    for run in prange(runs):
        for i in range(run * na // runs, (run + 1) * na // runs):
            _primal_plane(x, pa, pb, pc, i, _f(threshold), w0, w1, w2, _f(floor), zero, planes[run, 0])
            for j in range(nb):
                for k in range(nc):
                    out[i, j, k] = planes[run, 0, j, k]


def dual_step(
    x: F32, p: DualField, threshold: float, weights: Weights, nonnegative: bool, scratch: DualScratch,
    back: tuple[int, int] = (0, 0),
) -> None:  # fmt: skip
    """p <- projection onto |p| <= 1 of p + pace D P(x - threshold Dᵀ p), in place; P clips negative values or none.

    Projected gradient ascent of the dual of min ½|y - x|² + threshold TV(y) (Chambolle 2004; with P: Beck & Teboulle
    2009, eq. 4.6), at 0.75 of the longest step that converges by itself. Nearer to the longest, the sign of the finest
    differences alternates from step to step, and an outer iteration with momentum amplifies them.

    Args:
        scratch: see `dual_scratch`.
        back: of the first two axes: 1 where |p| of a voxel takes the difference from the voxel before, 0 where it
            takes the one to the next. It is total variation as a mirror image sees it.
    """
    pace = 1.5 / (4 * sum(w * w for w in weights)) / threshold
    floor = 0.0 if nonnegative else _NO_FLOOR
    _dual_step(x, *p, threshold, pace, weights, floor, *back, *scratch)


def primal(
    x: F32, p: DualField, threshold: float, weights: Weights, nonnegative: bool, scratch: DualScratch, out: F32
) -> None:
    """out = P(x - threshold Dᵀ p); `out` may be `x`."""
    _primal(x, *p, threshold, weights, 0.0 if nonnegative else _NO_FLOOR, scratch.planes, out)


def dual_field(shape: tuple[int, int, int]) -> DualField:
    """Zeros [a, b, c] for the differences along each axis: at i, that from i to i + 1.

    Each begins some cache lines later than a multiple of its size. Fields a power of two apart share one set of the
    cache: a step of 1024 x 1024 x 64 voxels took three times as long.
    """
    size = math.prod(shape)
    room = np.zeros(3 * (size + _APART), np.float32)
    a, b, c = (room[at : at + size].reshape(shape) for at in (n * (size + _APART) for n in range(3)))
    return a, b, c


def dual_scratch(shape: tuple[int, int, int]) -> DualScratch:
    """Scratch for `dual_step` and `primal`.

    Two arrays, each without gaps: from parts of one the compiler makes code that gathers single numbers, at a third of
    the speed.
    """
    runs, (_, b, c) = _runs(shape), shape
    return DualScratch(np.empty((runs, b, c + 1), np.float32), np.empty((runs, 2, b, c + 1), np.float32))


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
