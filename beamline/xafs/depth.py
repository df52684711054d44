"""Depth: line integrals of counts, +inf without transmitted light and NaN without a value."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]

LEAST = 0.5
"""Fewest counts above the dark level that count as light."""
LEAST_SHARE = 1e-3
"""The same as a share of the flat, where that is less, so that flats may be normalised to 1."""


def line_integrals(signal: Reals, flat: Reals) -> Reals:
    """-log(signal / flat), [row, col], of counts above the dark level. +inf where no light was transmitted, NaN where
    the flat is dark too, or where one of them is not finite."""
    lit = np.minimum(LEAST, LEAST_SHARE * flat)
    out = np.full(np.broadcast_shapes(signal.shape, flat.shape), np.nan)
    known = np.isfinite(signal) & (flat > 0) & (flat < np.inf)
    np.log(np.divide(flat, signal, where=known & (signal > lit), out=out), where=known & (signal > lit), out=out)
    out[known & (signal <= lit)] = np.inf
    return out
