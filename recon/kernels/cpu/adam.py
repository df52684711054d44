"""Adam over all parameter arrays in one threaded pass (Kingma & Ba 2015, algorithm 1), and sums of vector lengths."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from recon.kernels.cpu import lanes
from recon.kernels.cpu.activation import F32, OPTIONS

_f = np.float32
BETA1, BETA2 = 0.9, 0.999
_TASK = 4096  # numbers
_WIDEST = float(np.finfo(np.float32).max)


@njit(**OPTIONS)
def _adam(
    parameters: tuple[F32, ...],
    gradients: tuple[F32, ...],
    first: tuple[F32, ...],
    second: tuple[F32, ...],
    rates: F32,
    bounds: F32,
    scale2: float,
    eps: float,
    tasks: NDArray[np.int64],
) -> None:
    """One pass over flat arrays [1, size].

    Tasks [k, 2] contain the number of an array and the start of a piece of it.
    """
    b1, b2 = _f(BETA1), _f(BETA2)
    s2, e, one = _f(scale2), _f(eps), _f(1)
    for task in prange(tasks.shape[0]):
        which, begin = tasks[task]
        p, g, m, v = parameters[which], gradients[which], first[which], second[which]
        rate, low, high = rates[which], bounds[which, 0], bounds[which, 1]
        end = min(p.size, begin + _TASK)
        for j in range(begin, end, lanes.WIDTH):
            count = min(lanes.WIDTH, end - j)
            slope = lanes.load_first(g, 0, j, count)
            mean = lanes.load_first(m, 0, j, count) * b1 + slope * (one - b1)
            power = lanes.load_first(v, 0, j, count) * b2 + slope * slope * (one - b2)
            value = lanes.load_first(p, 0, j, count) - mean * rate / (lanes.root(power * s2) + e)
            lanes.store_first(m, 0, j, mean, count)
            lanes.store_first(v, 0, j, power, count)
            lanes.store_first(p, 0, j, lanes.clamp(value, low, high), count)


@lru_cache(maxsize=16)
def _tasks(sizes: tuple[int, ...]) -> NDArray[np.int64]:
    found = [(k, begin) for k, size in enumerate(sizes) for begin in range(0, size, _TASK)]
    return np.array(found, np.int64).reshape(-1, 2)


def adam_all(
    parameters: Sequence[F32],
    gradients: Sequence[F32],
    first: Sequence[F32],
    second: Sequence[F32],
    rates: Sequence[float],
    step: int,
    bounds: Sequence[tuple[float, float] | None] | None = None,
    eps: float = 1e-15,
) -> None:
    """Update C-contiguous arrays of any shape and their moments in place; `step` counts from 1.

    Args:
        rates: learning rate of each array.
        bounds: (lowest, highest) value of each array, enforced after the update; None: unbounded.

    Raises:
        ValueError: shapes do not match, or an array is not contiguous (then only a copy would be updated).
    """
    lists = (parameters, gradients, first, second)
    for arrays in zip(*lists, strict=True):
        if any(a.shape != arrays[0].shape or not a.flags.c_contiguous for a in arrays):
            shapes = [(a.shape, "C" if a.flags.c_contiguous else "not contiguous") for a in arrays]
            raise ValueError(
                f"a parameter, its gradient and its moments must be C-contiguous and have the same shape, got {shapes}"
            )
    limits = [(-_WIDEST, _WIDEST) if b is None else b for b in bounds or [None] * len(parameters)]
    scale1, scale2 = 1 / (1 - BETA1**step), 1 / (1 - BETA2**step)
    _adam(
        *(tuple(a.reshape(1, -1) for a in arrays) for arrays in lists),
        np.array([rate * scale1 for rate in rates], np.float32), np.array(limits, np.float32), scale2, eps,
        _tasks(tuple(p.size for p in parameters)),
    )  # fmt: skip


@njit(**OPTIONS)
def add_lengths(vectors: F32, factor: float, sums: F32) -> None:
    """sums [n] += factor * |vectors [n, 2]|: accumulates gradients of the centres of footprints for density control."""
    for i in prange(sums.shape[0]):
        x, y = vectors[i, 0], vectors[i, 1]
        sums[i] += _f(factor) * _f(math.sqrt(x * x + y * y))
