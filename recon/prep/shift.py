"""The displacement between two views at the same angle, to a fraction of a pixel.

The peak of the cross-correlation of both views' slopes, to a pixel. From there least squares over light, slope of the
light, gain, and the shift across and down (Gauss-Newton), on views smoothed by a pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

F64 = NDArray[np.float64]
SMOOTH = 1.0
"""Pixels: standard deviation of the smoothing. A spline then shifts sharp edges well."""
REACH = 0.25
"""Share of rows and columns that a view may be displaced by."""
ROUNDS = 12
ENOUGH = 1e-4
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
    a, b = (ndimage.gaussian_filter(_filled(view), SMOOTH, mode="nearest") for view in (first, again))
    rows, cols = a.shape
    if rows < 4 or cols < 8:
        return UNKNOWN
    down, across = _nearest(a, b)
    down_pixels, across_pixels = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, cols), indexing="ij")
    for _ in range(ROUNDS):
        moved = ndimage.shift(a, (down, across), order=3, mode="nearest")
        inside = tuple(
            slice(2 + max(0, math.ceil(by)), n - 2 + min(0, math.floor(by))) for n, by in ((rows, down), (cols, across))
        )
        by_row, by_col = np.gradient(moved)
        basis = np.stack([
            each[inside].ravel()
            for each in (-by_col, -by_row, moved, np.ones_like(a), across_pixels, down_pixels)
        ])  # fmt: skip
        left = (b - moved)[inside].ravel()
        if left.size < 2 * len(basis):
            return UNKNOWN
        normal = basis @ basis.T
        size = np.sqrt(np.diag(normal))
        scale = np.where(size > 0, size, 1.0)
        inverse = np.linalg.pinv(normal / np.outer(scale, scale), rcond=1e-6, hermitian=True) / np.outer(scale, scale)
        step = inverse @ (basis @ left)
        more_across, more_down = (float(np.clip(each, -1, 1)) for each in step[:2])
        across, down = across + more_across, down + more_down
        if abs(across) > REACH * cols or abs(down) > REACH * rows:
            return UNKNOWN
        if max(abs(more_across), abs(more_down)) < ENOUGH:
            break
    return _known(moved[inside].ravel(), b[inside].ravel(), left - basis.T @ step, inverse, size, (across, down))


def _known(moved: F64, seen: F64, rest: F64, inverse: F64, size: F64, shift: tuple[float, float]) -> ViewShift:
    """The shift where the views determine it.

    Args:
        moved, seen: [pixel], the first view after the shift, and the second.
        rest: [pixel], what the least squares leave.
        inverse, size: of their normal equations, and norms of their terms; the shifts come first.
    """
    spread = 4 * math.pi * SMOOTH**2  # pixels that share their noise
    alike = float(np.corrcoef(moved, seen)[0, 1]) if moved.std() > 0 else 0.0
    if not alike * math.sqrt(rest.size / spread) > SIGMAS:
        return UNKNOWN
    variance = float((rest**2).mean()) * spread
    sigmas = [
        math.sqrt(variance * float(inverse[i, i])) if inverse[i, i] > 0 and size[i] > 0 else math.inf for i in range(2)
    ]
    told = [value if sigma < KNOWN else math.nan for value, sigma in zip(shift, sigmas, strict=True)]
    return ViewShift(*told, *(sigma if sigma < KNOWN else math.nan for sigma in sigmas))


def _filled(view: NDArray[np.floating]) -> F64:
    values = np.asarray(view, np.float64)
    good = np.isfinite(values)
    return np.where(good, values, np.median(values[good]) if good.any() else 0.0)


def _nearest(a: F64, b: F64) -> tuple[float, float]:
    """Whole pixels down and across: displaced so far, `a` fits `b` best."""
    shape = [fft.next_fast_len(n + int(REACH * n) + 1, real=True) for n in a.shape]
    correlation = np.zeros(shape)
    for axis in range(2):
        one, other = (fft.rfft2(np.gradient(view, axis=axis), shape) for view in (a, b))
        correlation += fft.irfft2(other * one.conj(), shape)
    moves = [fft.fftfreq(n, 1 / n).round() for n in shape]
    near = np.outer(*(np.abs(move) <= REACH * n for move, n in zip(moves, a.shape, strict=True)))
    row, col = np.unravel_index(int(np.where(near, correlation, -np.inf).argmax()), correlation.shape)
    return float(moves[0][row]), float(moves[1][col])
