"""Fused losses on the CPU: L1, D-SSIM and total variation with their gradients in a few passes (numba, threaded)."""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from recon.kernels.activation import F32, OPTIONS

_f = np.float32
RADIUS = 5  # an 11 x 11 window


def gaussian_window(sigma: float = 1.5) -> F32:
    """The 11 taps of SSIM's Gaussian window, summing to 1 (Wang et al. 2004)."""
    taps = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / sigma) ** 2)
    return (taps / taps.sum()).astype(np.float32)


@njit(**OPTIONS)
def _blur(maps: F32, window: F32, half: F32, out: F32) -> None:
    """Separable window over each of maps [k, row, col], zeros outside; `half` is scratch of the same shape."""
    k_maps, rows, cols = maps.shape
    for job in prange(k_maps * rows):
        k, row = job // rows, job % rows
        target = half[k, row]
        target[:] = _f(0)
        for tap in range(-RADIUS, RADIUS + 1):
            other = row + tap
            if 0 <= other < rows:
                weight, source = window[tap + RADIUS], maps[k, other]
                for col in range(cols):
                    target[col] += weight * source[col]
    for job in prange(k_maps * rows):
        k, row = job // rows, job % rows
        source, target = half[k, row], out[k, row]
        target[:] = _f(0)
        for tap in range(-RADIUS, RADIUS + 1):
            low, high = max(0, -tap), min(cols, cols - tap)
            weight = window[tap + RADIUS]
            for col in range(low, high):
                target[col] += weight * source[col + tap]


@njit(**OPTIONS)
def _products(image: F32, maps: F32, target: F32) -> None:
    for row in prange(image.shape[0]):
        for col in range(image.shape[1]):
            x = image[row, col]
            maps[0, row, col] = x
            maps[1, row, col] = x * x
            maps[2, row, col] = x * target[row, col]


@njit(**OPTIONS)
def _ssim_terms(
    blurred: F32, target_blurred: F32, c1: float, c2: float, partials: F32, sums: NDArray[np.float64]
) -> None:
    """Partial derivatives of the SSIM map with respect to the blurred maps x, x², xy; sums [row] of the map itself."""
    one, two, k1, k2 = _f(1), _f(2), _f(c1), _f(c2)
    for row in prange(blurred.shape[1]):
        amount = 0.0
        for col in range(blurred.shape[2]):
            mx, my = blurred[0, row, col], target_blurred[0, row, col]
            vx = blurred[1, row, col] - mx * mx
            vy = target_blurred[1, row, col] - my * my
            vxy = blurred[2, row, col] - mx * my
            top1, top2 = two * mx * my + k1, two * vxy + k2
            low1, low2 = one / (mx * mx + my * my + k1), one / (vx + vy + k2)
            value = top1 * top2 * low1 * low2
            amount += value
            d_vx = -value * low2
            d_vxy = two * top1 * low1 * low2
            d_mx = two * my * top2 * low1 * low2 - two * mx * value * low1
            partials[0, row, col] = d_mx - two * mx * d_vx - my * d_vxy
            partials[1, row, col] = d_vx
            partials[2, row, col] = d_vxy
        sums[row] = amount


@njit(**OPTIONS)
def _combine(
    image: F32, target: F32, blurred: F32, l1: float, ssim: float, gradient: F32, sums: NDArray[np.float64]
) -> None:
    for row in prange(image.shape[0]):
        amount = 0.0
        for col in range(image.shape[1]):
            x, y = image[row, col], target[row, col]
            difference = x - y
            amount += abs(difference)
            sign = _f(l1) if difference > 0 else (-_f(l1) if difference < 0 else _f(0))
            slope = blurred[0, row, col] + _f(2) * x * blurred[1, row, col] + y * blurred[2, row, col]
            gradient[row, col] = sign - _f(ssim) * slope
        sums[row] = amount


class ProjectionLoss:
    """mean |x - y| + λ (1 - SSIM(x, y)) and its gradient, for many images x against few targets y.

    The target's blurred maps do not change during a fit, so they are computed once per view.
    """

    def __init__(self, shape: tuple[int, int], ssim_weight: float, c1: float = 0.01**2, c2: float = 0.03**2) -> None:
        rows, cols = shape
        self.ssim_weight, self.c1, self.c2 = ssim_weight, c1, c2
        self.window = gaussian_window()
        self._maps = np.empty((3, rows, cols), np.float32)
        self._scratch = np.empty((3, rows, cols), np.float32)
        self._blurred = np.empty((3, rows, cols), np.float32)
        self._partials = np.empty((3, rows, cols), np.float32)
        self._sums = np.empty(rows, np.float64)

    def target_maps(self, target: F32) -> F32:
        """Blurred y and y² [2, row, col] of a target image."""
        maps = np.stack((target, target * target))
        out = np.empty_like(maps)
        _blur(maps, self.window, np.empty_like(maps), out)
        return out

    def __call__(self, image: F32, target: F32, target_maps: F32, gradient: F32) -> float:
        """The loss; `gradient` [row, col] receives its derivative with respect to `image`."""
        pixels = image.size
        _products(image, self._maps, target)
        _blur(self._maps, self.window, self._scratch, self._blurred)
        _ssim_terms(self._blurred, target_maps, self.c1, self.c2, self._partials, self._sums)
        ssim = float(self._sums.sum()) / pixels
        _blur(self._partials, self.window, self._scratch, self._blurred)
        weight = self.ssim_weight / pixels
        _combine(image, target, self._blurred, 1.0 / pixels, weight, gradient, self._sums)
        return float(self._sums.sum()) / pixels + self.ssim_weight * (1.0 - ssim)


@njit(**OPTIONS)
def _total_variation(volume: F32, weight: float, gradient: F32, sums: NDArray[np.float64]) -> None:
    nz, ny, nx = volume.shape
    w = _f(weight)
    for z in prange(nz):
        amount = 0.0
        for y in range(ny):
            for x in range(nx):
                here, slope = volume[z, y, x], _f(0)
                if x + 1 < nx:
                    step = volume[z, y, x + 1] - here
                    amount += abs(step)
                    slope -= np.sign(step)
                if y + 1 < ny:
                    step = volume[z, y + 1, x] - here
                    amount += abs(step)
                    slope -= np.sign(step)
                if z + 1 < nz:
                    step = volume[z + 1, y, x] - here
                    amount += abs(step)
                    slope -= np.sign(step)
                if x > 0:
                    slope += np.sign(here - volume[z, y, x - 1])
                if y > 0:
                    slope += np.sign(here - volume[z, y - 1, x])
                if z > 0:
                    slope += np.sign(here - volume[z - 1, y, x])
                gradient[z, y, x] = w * slope
        sums[z] = amount


def total_variation(volume: F32, gradient: F32, weight: float) -> float:
    """weight * mean |difference of neighbours| over the three axes; `gradient` [z, y, x] receives its derivative.

    The mean runs over all differences of the box (Zha et al. 2024).
    """
    nz, ny, nx = volume.shape
    count = (nz - 1) * ny * nx + nz * (ny - 1) * nx + nz * ny * (nx - 1)
    if count == 0:
        gradient[...] = 0
        return 0.0
    sums = np.empty(nz, np.float64)
    _total_variation(volume, weight / count, gradient, sums)
    return weight * float(sums.sum()) / count
