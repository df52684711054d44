"""Counting: counts of line integrals by a vectorised exponential (numba's own is scalar).

numpy's is as fast, but cannot be called inside a kernel, where a row is still in the cache.
"""

from __future__ import annotations

import math

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from simulators.samples.bodies.chords import KERNEL, Reals

Counts = NDArray[np.uint16]

# 2^x on [-1/2, 1/2], interpolated at Chebyshev points, degree 9: relative error 2e-14.
_EXP2 = (
    1.000000000000014, 0.6931471805599526, 0.24022650695631514, 0.05550410866428854, 0.009618129195951041,
    0.001333355825801874, 0.00015403432339553542, 1.5252640059770786e-05, 1.3259945262689143e-06,
    1.0212097549811005e-07,
)  # fmt: skip
_C0, _C1, _C2, _C3, _C4, _C5, _C6, _C7, _C8, _C9 = _EXP2
_LOG2E = math.log2(math.e)
_ROUND = 1.5 * 2.0**52  # adding it puts the nearest integer into the last bits
_FAR = 1000.0  # binary orders of magnitude: beyond, there is no light or too much
DOUBT = 1e-7  # counts from a half-integer: 70 times the error of this module at full range


@intrinsic
def _bits(context, x):  # type: ignore[no-untyped-def]
    """The bits of a float64 as an int64."""
    return types.int64(types.float64), lambda _, builder, __, args: builder.bitcast(args[0], ir.IntType(64))


@intrinsic
def _real(context, x):  # type: ignore[no-untyped-def]
    """The float64 of these bits."""
    return types.float64(types.int64), lambda _, builder, __, args: builder.bitcast(args[0], ir.DoubleType())


@njit(fastmath={"contract"}, **KERNEL)
def to_counts(depth: Reals, open_beam: float, top: float, out: Counts) -> bool:
    """Counts of line integrals; returns whether any is so close to a half-integer that its rounding is in doubt."""
    doubts = 0
    for i in range(depth.size):
        x = min(max(depth[i] * -_LOG2E, -_FAR), _FAR)
        whole = x + _ROUND
        f = x - (whole - _ROUND)
        # Estrin's scheme: several independent multiply-adds at once
        f2 = f * f
        f4 = f2 * f2
        low = (_C0 + _C1 * f) + (_C2 + _C3 * f) * f2
        high = (_C4 + _C5 * f) + (_C6 + _C7 * f) * f2
        y = low + (high + (_C8 + _C9 * f) * f4) * f4
        count = min(open_beam * _real(_bits(y) + (_bits(whole) << 52)), top)
        nearest = count + _ROUND
        doubts += abs(abs(count - (nearest - _ROUND)) - 0.5) < DOUBT
        out[i] = np.uint16(_bits(nearest))
    return doubts > 0
