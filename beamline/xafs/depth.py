"""Depth: line integrals of counts, and what stands where there are none."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]

LEAST = 0.5
"""Counts above the dark that are light at all."""
LEAST_SHARE = 1e-3
"""The same as a share of the flat, where that is the less: flats of 1 are as good as flats of 5000."""


def line_integrals(signal: Reals, flat: Reals) -> Reals:
    """-log(signal / flat), [row, col], of counts above the dark; +inf where no light came through, NaN where the flat
    has none either, or either of them is no number."""
    lit = np.minimum(LEAST, LEAST_SHARE * flat)
    out = np.full(np.broadcast_shapes(signal.shape, flat.shape), np.nan)
    known = np.isfinite(signal) & (flat > 0) & (flat < np.inf)
    np.log(np.divide(flat, signal, where=known & (signal > lit), out=out), where=known & (signal > lit), out=out)
    out[known & (signal <= lit)] = np.inf
    return out
