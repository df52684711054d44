"""Cubic splines through even places, with mirrored ends. scipy.interpolate, for any places, takes a quarter second."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from recon.base.arrays import F64

_TAPS = (  # by derivative and place: polynomials of the fraction of a step, the highest power first
    np.array([(-1, 3, -3, 1), (3, -6, 0, 4), (-3, 3, 3, 1), (1, 0, 0, 0)]) / 6,
    np.array([(-1, 2, -1), (3, -4, 0), (-3, 2, 1), (1, 0, 0)]) / 2,
    np.array([(-1, 1), (3, -2), (-3, 1), (1, 0)]),
)


def spline_through(values: NDArray[np.floating]) -> F64:
    """Coefficients [..., n] of the spline through values [..., n] at 0, 1 ... n - 1."""
    return np.asarray(scipy.ndimage.spline_filter1d(values, 3, axis=-1, output=np.float64, mode="mirror"))


def value_at(spline: F64, places: F64, derivative: int = 0) -> F64:
    """The spline, or its first or second derivative, at places from 0 to n - 1; beyond them as at the nearest.

    Args:
        spline: [..., n].
        places: [..., place], whose first axes are those of the spline, or of length 1.
    """
    n = spline.shape[-1]
    inside = np.clip(places, 0, n - 1)
    first = np.minimum(np.floor(inside).astype(np.int64), n - 2)
    total = np.zeros(np.broadcast_shapes(spline.shape[:-1], places.shape[:-1]) + places.shape[-1:])
    for k, taps in enumerate(_TAPS[derivative]):
        tap = np.abs(first + k - 1)
        tap = np.where(tap >= n, 2 * (n - 1) - tap, tap)
        at = np.broadcast_to(tap, total.shape)
        total += np.polyval(taps, inside - first) * np.take_along_axis(spline, at, axis=-1)
    return total
