"""The displacement between two views at the same angle, to a fraction of a pixel.

The peak of the cross-correlation of both views' slopes, which light and its slope hardly change, by an upsampled
Fourier transform (Guizar-Sicairos, Thurman & Fienup 2008, Opt. Lett. 33, 156), on views smoothed by a pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

F64 = NDArray[np.float64]
SMOOTH = 1.0
"""Pixels: standard deviation of the smoothing. A spline then shifts sharp edges well."""
REACH = 0.25
"""Share of rows and columns that a view may be displaced by."""
FINER = 100
"""Steps of a pixel."""
EVEN = 1e-6
"""Share of the other way's change: with less, all rows or columns are equal."""
SIGMAS = 8.0
"""The least correlation of both views, in standard deviations of that of noise."""
KNOWN = 0.25
"""Pixels: a displacement with a larger uncertainty is not known."""


@dataclass(frozen=True)
class ViewShift:
    """Displacement of a view against another: pixels towards higher columns, and towards higher rows.

    Each has its uncertainty by noise (one standard deviation). NaN: the views do not tell it, as with rows all alike.
    """

    across: float
    down: float
    across_sigma: float
    down_sigma: float


UNKNOWN = ViewShift(math.nan, math.nan, math.nan, math.nan)


def shift_between(first: NDArray[np.floating], again: NDArray[np.floating]) -> ViewShift:
    """The displacement of `again` against `first`.

    Args:
        first, again: float [row, col], line integrals. NaN: not measured.
    """
    from skimage.registration import phase_cross_correlation  # here: half a second

    a, b = (ndimage.gaussian_filter(_filled(view), SMOOTH, mode="nearest") for view in (first, again))
    if a.shape[0] < 4 or a.shape[1] < 8:
        return UNKNOWN
    room = [(0, int(REACH * n)) for n in a.shape]
    slopes = [np.pad(view, room) for view in (_slopes(a), _slopes(b))]
    found = phase_cross_correlation(slopes[1], slopes[0], upsample_factor=FINER, normalization=None)[0]
    down, across = (float(by) for by in found)
    moved = _slopes(ndimage.shift(a, (down, across), order=3, mode="nearest"))
    rim = [3 + math.ceil(abs(by)) for by in (down, across)]
    inside = np.s_[rim[0] : a.shape[0] - rim[0], rim[1] : a.shape[1] - rim[1]]
    one, other = moved[inside].ravel(), _slopes(b)[inside].ravel()
    power = math.sqrt(float((np.abs(one) ** 2).sum() * (np.abs(other) ** 2).sum()))
    spread = 4 * math.pi * SMOOTH**2  # pixels that share their noise
    if not power > 0 or float((one.conj() * other).real.sum()) / power * math.sqrt(one.size / spread) <= SIGMAS:
        return UNKNOWN
    rest = other - one * float((one.conj() * other).real.sum() / (np.abs(one) ** 2).sum())
    variance = float((np.abs(rest) ** 2).mean()) / 2 * spread
    bends = [float((np.abs(np.gradient(moved, axis=axis)[inside]) ** 2).sum()) for axis in (1, 0)]
    sigmas = [math.sqrt(variance / bend) if bend > EVEN * max(bends) else math.inf for bend in bends]
    known = [1.0 if sigma < KNOWN else math.nan for sigma in sigmas]
    return ViewShift(across * known[0], down * known[1], sigmas[0] * known[0], sigmas[1] * known[1])


def _slopes(view: F64) -> NDArray[np.complex128]:
    down, across = np.gradient(view)
    return np.asarray(down + 1j * across)


def _filled(view: NDArray[np.floating]) -> F64:
    values = np.asarray(view, np.float64)
    good = np.isfinite(values)
    return np.where(good, values, np.median(values[good]) if good.any() else 0.0)
