"""Local: parabolas through a few neighbouring points of a curve: values and slopes with less noise, at any spacing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]


def local_parabolas(x: Reals, y: Reals, window: int) -> tuple[Reals, Reals]:
    """Value and slope at each x of the parabola through the nearest `window` points (for even spacing the filter of
    Savitzky & Golay, Anal. Chem. 36, 1627, 1964); both [n], of at least `window` points."""
    values, slopes = np.empty_like(y), np.empty_like(y)
    for i in range(y.size):
        first = min(max(i - window // 2, 0), y.size - window)
        part = slice(first, first + window)
        values[i], slopes[i], _ = np.polynomial.polynomial.polyfit(x[part] - x[i], y[part], 2)
    return values, slopes
