"""Scalar products and linear combinations of whole volumes or projections, summed in float64 (numba, threaded)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from recon.kernels.cpu.activation import F32, OPTIONS

_f = np.float32
_RUN = 4096  # values that are summed in float32 before they are added to the float64 sum
_PARTS = 64  # number of parts of a sum; it does not depend on the number of threads, so results do not either


@njit(**OPTIONS)
def _dot(a: F32, b: F32, sums: NDArray[np.float64]) -> None:
    parts = sums.size
    for part in prange(parts):
        total = np.float64(0)
        end = (part + 1) * a.size // parts
        for start in range(part * a.size // parts, end, _RUN):
            x, y = a[start : min(start + _RUN, end)], b[start : min(start + _RUN, end)]
            run = _f(0)
            for i in range(x.size):
                run += x[i] * y[i]
            total += run
        sums[part] = total


def dot(a: F32, b: F32) -> float:
    """<a, b> of two arrays of one shape."""
    sums = np.empty(_PARTS)
    _dot(a.reshape(-1), b.reshape(-1), sums)
    return float(sums.sum())


def norm(x: F32) -> float:
    """The root of <x, x>."""
    return math.sqrt(dot(x, x))


@njit(**OPTIONS)
def _combine(alpha: float, a: F32, beta: float, b: F32, floor: float, out: F32) -> None:
    p, q, low = _f(alpha), _f(beta), _f(floor)
    for i in prange(out.size):
        out[i] = max(p * a[i] + q * b[i], low)


def combine(alpha: float, a: F32, beta: float, b: F32, out: F32) -> None:
    """out = alpha a + beta b; `out` may be `a` or `b`."""
    _combine(alpha, a.reshape(-1), beta, b.reshape(-1), float(np.finfo(np.float32).min), out.reshape(-1))


@njit(**OPTIONS)
def _add_product(x: F32, factor: float, a: F32, b: F32, floor: float) -> None:
    p, low = _f(factor), _f(floor)
    for i in prange(x.size):
        x[i] = max(x[i] + p * a[i] * b[i], low)


def add_product(x: F32, factor: float, a: F32, b: F32, nonnegative: bool) -> None:
    """x += factor a b, negative values clipped with `nonnegative`."""
    floor = 0.0 if nonnegative else float(np.finfo(np.float32).min)
    _add_product(x.reshape(-1), factor, a.reshape(-1), b.reshape(-1), floor)


@njit(**OPTIONS)
def _replace_by_residual(data: F32, model: F32, weight: F32, scale: F32, sums: NDArray[np.float64]) -> None:
    parts = sums.size
    for part in prange(parts):
        total = np.float64(0)
        end = (part + 1) * data.size // parts
        for start in range(part * data.size // parts, end, _RUN):
            some = slice(start, min(start + _RUN, end))  # the compiler vectorises slices
            p, q, run = data[some], model[some], _f(0)
            w, s = weight[some] if weight.size else p, scale[some] if scale.size else p
            for i in range(p.size):
                difference = p[i] - q[i]
                run += (w[i] if weight.size else _f(1)) * difference * difference
                q[i] = difference * (s[i] if scale.size else _f(1))
            total += run
        sums[part] = total


def replace_by_residual(data: F32, model: F32, weight: F32 | None = None, scale: F32 | None = None) -> float:
    """Replace `model` by scale (data - model); returns Σ weight (data - model)². None: all 1."""
    empty = np.empty(0, np.float32)
    sums = np.empty(_PARTS)
    weights, scales = (empty if array is None else array.reshape(-1) for array in (weight, scale))
    _replace_by_residual(data.reshape(-1), model.reshape(-1), weights, scales, sums)
    return float(sums.sum())


@njit(**OPTIONS)
def _turn_of_steps(before: F32, start: F32, end: F32, sums: NDArray[np.float64]) -> None:
    parts = sums.size
    for part in prange(parts):
        total = np.float64(0)
        stop = (part + 1) * end.size // parts
        for first in range(part * end.size // parts, stop, _RUN):
            some = slice(first, min(first + _RUN, stop))
            a, b, c = before[some], start[some], end[some]
            run = _f(0)
            for i in range(c.size):
                run += (b[i] - c[i]) * (c[i] - a[i])
            total += run
        sums[part] = total


def turn_of_steps(before: F32, start: F32, end: F32) -> float:
    """<start - end, end - before>: above zero if the step from `start` to `end` points back to `before`."""
    sums = np.empty(_PARTS)
    _turn_of_steps(before.reshape(-1), start.reshape(-1), end.reshape(-1), sums)
    return float(sums.sum())


@njit(**OPTIONS)
def _extrapolate(x: F32, factor: float, last: F32, start: F32) -> None:
    p = _f(factor)
    for i in prange(x.size):
        end = x[i]
        ahead = end + p * (end - last[i])
        last[i], start[i], x[i] = end, ahead, ahead


def extrapolate(x: F32, factor: float, last: F32, start: F32) -> None:
    """x += factor (x - last); `last` becomes x before the update, and `start` becomes x after it."""
    _extrapolate(x.reshape(-1), factor, last.reshape(-1), start.reshape(-1))
