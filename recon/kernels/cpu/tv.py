"""Total variation on the CPU: a step of the dual denoising problem, and the gradient of smoothed TV (numba, threaded).

    TV(x) = Σ |D x|,   (D x)_a = w_a (x[i + 1] - x[i]) along axis a, zero at the end;   w: for voxels that are not cubes

Volumes are [a, b, c], dual fields [3, a, b, c]. Each thread takes a run of planes and keeps two of them in its cache,
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
Weights = tuple[float, float, float]


class DualScratch(NamedTuple):
    """One plane [run, b, c + 1], and two [run, 2, b, c + 1], for each run of planes that one thread makes."""

    plane: F32
    planes: F32


@njit(fastmath=True, error_model="numpy", cache=True)
def _primal_plane(x, p, i, threshold, w0, w1, w2, floor, zero, out):
    """Plane i of max(x - threshold Dᵀ p, floor) into out [b, c + 1]; the last column is repeated."""
    nb, nc = x.shape[1], x.shape[2]
    for j in range(nb):
        here, row = x[i, j], out[j]
        p0, p1, p2 = p[0, i, j], p[1, i, j], p[2, i, j]
        before0 = p[0, i - 1, j] if i > 0 else zero
        before1 = p[1, i, j - 1] if j > 0 else zero
        row[0] = max(here[0] - threshold * (w0 * (before0[0] - p0[0]) + w1 * (before1[0] - p1[0]) - w2 * p2[0]), floor)
        for k in range(1, nc):
            pull = w0 * (before0[k] - p0[k]) + w1 * (before1[k] - p1[k]) + w2 * (p2[k - 1] - p2[k])
            row[k] = max(here[k] - threshold * pull, floor)
        row[nc] = row[nc - 1]


@njit(**OPTIONS)
def _dual_step(
    x: F32, p: F32, threshold: float, pace: float, weights: Weights, floor: float, edges: F32, planes: F32
) -> None:
    na, nb, nc = x.shape
    runs = edges.shape[0]
    w0, w1, w2 = _f(weights[0]), _f(weights[1]), _f(weights[2])
    zero = np.zeros(nc, np.float32)
    # The first plane of each run, before another thread changes the dual fields that it depends on.
    for run in prange(runs):
        _primal_plane(x, p, run * na // runs, _f(threshold), w0, w1, w2, _f(floor), zero, edges[run])
    for run in prange(runs):
        first, last = run * na // runs, (run + 1) * na // runs
        s0, s1, s2 = _f(pace) * w0, _f(pace) * w1, _f(pace) * w2
        for i in range(first, last):
            here = edges[run] if i == first else planes[run, i % 2]
            if i + 1 < last:
                after = planes[run, (i + 1) % 2]
                _primal_plane(x, p, i + 1, _f(threshold), w0, w1, w2, _f(floor), zero, after)
            else:
                after = edges[run + 1] if run + 1 < runs else here
            for j in range(nb):
                row, next_plane, next_row = here[j], after[j], here[min(j + 1, nb - 1)]
                p0, p1, p2 = p[0, i, j], p[1, i, j], p[2, i, j]
                for k in range(nc):
                    q0 = p0[k] + s0 * (next_plane[k] - row[k])
                    q1 = p1[k] + s1 * (next_row[k] - row[k])
                    q2 = p2[k] + s2 * (row[k + 1] - row[k])
                    shrink = _f(1) / max(_f(1), np.sqrt(q0 * q0 + q1 * q1 + q2 * q2))
                    p0[k], p1[k], p2[k] = q0 * shrink, q1 * shrink, q2 * shrink


@njit(**OPTIONS)
def _primal(x: F32, p: F32, threshold: float, weights: Weights, floor: float, planes: F32, out: F32) -> None:
    na, nb, nc = x.shape
    w0, w1, w2 = _f(weights[0]), _f(weights[1]), _f(weights[2])
    zero = np.zeros(nc, np.float32)
    runs = planes.shape[0]
    for run in prange(runs):
        for i in range(run * na // runs, (run + 1) * na // runs):
            _primal_plane(x, p, i, _f(threshold), w0, w1, w2, _f(floor), zero, planes[run, 0])
            for j in range(nb):
                for k in range(nc):
                    out[i, j, k] = planes[run, 0, j, k]


def dual_step(x: F32, p: F32, threshold: float, weights: Weights, nonnegative: bool, scratch: DualScratch) -> None:
    """p <- projection onto |p| <= 1 of p + pace D P(x - threshold Dᵀ p), in place; P clips negative values or none.

    Projected gradient ascent of the dual of min ½|y - x|² + threshold TV(y) (Chambolle 2004; with P: Beck & Teboulle
    2009, eq. 4.6), at 0.75 of the longest step that converges by itself. Nearer to the longest, the sign of the finest
    differences alternates from step to step, and an outer iteration with momentum amplifies them.

    Args:
        scratch: see `dual_scratch`.
    """
    pace = 1.5 / (4 * sum(w * w for w in weights)) / threshold
    floor = 0.0 if nonnegative else _NO_FLOOR
    _dual_step(x, p, threshold, pace, weights, floor, *scratch)


def primal(
    x: F32, p: F32, threshold: float, weights: Weights, nonnegative: bool, scratch: DualScratch, out: F32
) -> None:
    """out = P(x - threshold Dᵀ p); `out` may be `x`."""
    _primal(x, p, threshold, weights, 0.0 if nonnegative else _NO_FLOOR, scratch.planes, out)


@njit(**OPTIONS)
def _mirror(x: F32, span0: int, span1: int, span2: int, sign: float) -> None:
    na, nb, nc = x.shape
    s = _f(sign)
    for job in prange(na):
        i = np.int64(job)
        to = span0 - 1 - i if span0 > 0 else i
        if to < i:
            continue  # done from the other end; also what lies beyond the span
        for j in range(nb):
            there = span1 - 1 - j if span1 > 0 else j
            if there < 0 or (to == i and there < j):
                continue
            here, other = x[i, j], x[to, there]
            alone = to == i and there == j
            for k in range(span2 if span2 > 0 else nc):
                end = span2 - 1 - k if span2 > 0 else k
                if alone and end < k:
                    break
                value = here[k]
                here[k] = s * other[end]
                other[end] = s * value


def mirror(x: F32, axes: tuple[int, ...], differences: int | None = None) -> None:
    """Reverse [a, b, c] along `axes` in place; with `differences`, the axis of these, as part of a dual field.

    The difference from i to i + 1 lies at i. Seen from the other end it changes its sign, and lies at n - 2 - i; the
    last place holds none, and stays.
    """
    if not axes:
        return
    spans = [n if axis in axes else 0 for axis, n in enumerate(x.shape)]
    sign = 1.0
    if differences in axes:
        spans[differences], sign = max(x.shape[differences] - 1, 1), -1.0
    _mirror(x, *spans, sign)


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
