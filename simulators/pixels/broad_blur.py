"""Broad blur: a wide, round blur, computed on a smaller image because the result has no fine detail.

Edges are mirrors, so that the sum of the image is conserved to rounding. A blur is given by its transfer function of (ω
width)², with the angular frequency ω. There ω² is replaced by the discrete Laplacian's symbol, (2 - 2 cos ω_x) + (2 - 2
cos ω_y). Each transfer function of this module is a mixture of Gaussians, so that its kernel is a mixture of discrete
Gaussians (Lindeberg 1990). These Gaussians are nonnegative at any width, so the number of photons is nonnegative, too.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from recon.base.jit import njit, thread_count
from simulators.pixels.bands import share_rows

Image = NDArray[np.float64]
Transfer = Callable[[Image], Image]
COARSE = 4
"""Least width of a blur in pixels of the smaller image; a larger value is finer and slower."""
FAR = 1e6
"""Largest width of a blur, in widths of the frame: with this width the intensity is even."""


def gaussian(s: Image) -> Image:
    """Kernel exp(-r²/2w²) / 2πw²."""
    return np.exp(-0.5 * s)


def exponential(s: Image) -> Image:
    """Kernel exp(-r/w) / 2πw²."""
    return (1 + s) ** -1.5


def lorentzian(s: Image) -> Image:
    """Kernel w / 2π (r² + w²)^1.5, the two-dimensional Lorentzian; its line spread is w / π (x² + w²)."""
    return np.exp(-np.sqrt(s))


def broad_blur(image: Image, width: float, transfer: Transfer) -> Image:
    """The blurred image, shrunk by the largest factor that divides it and leaves COARSE pixels in the width.

    Args:
        image: float64 [row, col], >= 0.
        width: pixels.

    Returns:
        float64 [rows / factor, cols / factor], means over factor x factor pixels; see add_enlarged.
    """
    rows, cols = image.shape
    shared = math.gcd(rows, cols)
    width = min(width, FAR * max(rows, cols))
    factor = max((f for f in range(1, min(int(width / COARSE), shared) + 1) if shared % f == 0), default=1)
    small = np.empty((rows // factor, cols // factor))
    share_rows(lambda first, end: _shrink(first, end, image, small), small.shape)
    laplacian = _symbol(small.shape[0])[:, None] + _symbol(small.shape[1])
    threads = thread_count()
    spectrum = fft.dctn(small, overwrite_x=True, workers=threads)
    spectrum *= transfer(laplacian * (width / factor) ** 2)
    blurred = fft.idctn(spectrum, overwrite_x=True, workers=threads)
    return np.maximum(blurred, 0.0, out=blurred)  # negative by rounding only: the kernel is nonnegative


def _symbol(n: int) -> NDArray[np.float64]:
    return 2 - 2 * np.cos(np.pi * np.arange(n) / n)


@njit(cache=True, nogil=True)
def _shrink(begin: int, end: int, image: Image, small: Image) -> None:
    """Rows begin ... end of `small`: means over blocks of `image`."""
    factor = image.shape[0] // small.shape[0]
    for j in range(begin, end):
        line = np.zeros(image.shape[1])
        for k in range(j * factor, (j + 1) * factor):
            for i in range(line.size):
                line[i] += image[k, i]
        for i in range(small.shape[1]):
            small[j, i] = line[i * factor : (i + 1) * factor].sum() / factor**2


def add_enlarged(image: Image, small: Image, share: float) -> None:
    """image += share x small, interpolated linearly between the centres of its pixels and constant at the edges.

    The sum grows by share x sum of small x pixels of a block, to rounding: linear interpolation preserves the mean.
    """
    share_rows(lambda first, end: _add_enlarged(first, end, image, small, share), image.shape)


@njit(cache=True, nogil=True)
def _add_enlarged(begin: int, end: int, image: Image, small: Image, share: float) -> None:
    """Rows begin ... end of add_enlarged."""
    factor = image.shape[0] // small.shape[0]
    rows, cols = small.shape
    for j in range(begin, end):
        y = (j + 0.5) / factor - 0.5
        first = math.floor(y)
        above, below = share * (first + 1 - y), share * (y - first)
        upper, lower = small[max(first, 0)], small[min(first + 1, rows - 1)]
        line = np.empty(cols + 2)
        line[1:-1] = above * upper + below * lower
        line[0], line[-1] = line[1], line[-2]
        for k in range(factor):
            x = (k + 0.5) / factor + 0.5
            left = int(x)
            part = x - left
            for i in range(cols):
                image[j, i * factor + k] += (1 - part) * line[i + left] + part * line[i + left + 1]
