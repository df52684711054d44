"""Fused losses on the CPU: data term, D-SSIM and total variation with their gradients (numba, threaded)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from recon.kernels.cpu import lanes
from recon.kernels.cpu.activation import F32, OPTIONS

_f = np.float32
RADIUS = 5  # an 11 x 11 window
MARGIN = 16  # zeros to the left and right of a line
TASK_ROWS = 8
_LARGEST = np.float32(1e38)
L1, L2, POISSON = range(3)


class DataTerm(NamedTuple):
    """Data term of a pixel x with target y; with the scale δ all three have a similar size if |x - y| is about δ.

    L1: |x - y|.   L2: (x - y)² / 2δ.   POISSON: e^(-depth y) (x - y)² / 2δ, the second-order expansion of the
    likelihood of counts that fall with e^(-depth y) (Sauer & Bouman 1993, IEEE Trans. Signal Process. 41, 534). A y
    below 0 (transmission above 1) gets the weight of y = 0; otherwise a few such pixels would outweigh all others.
    """

    kind: int
    delta: float
    depth: float


ABSOLUTE = DataTerm(L1, 1.0, 1.0)


def gaussian_window(sigma: float = 1.5) -> F32:
    """The 11 taps of SSIM's Gaussian window, summing to 1 (Wang et al. 2004)."""
    taps = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / sigma) ** 2)
    return (taps / taps.sum()).astype(np.float32)


@njit(inline="always", fastmath=True)
def _columns(start, cols, width):
    """Sixteen columns for the block at `start`: the first column, and the lanes (low, high) that are not in the block
    before."""
    first = min(start, width - lanes.WIDTH)
    return first, start - first, cols - first


@njit(inline="always", fastmath=True)
def _down(plane, row, first, window):
    """The window applied down the columns of plane [row, col], zeros outside, for sixteen columns."""
    blurred = lanes.zero()
    for window_row in range(max(0, row - RADIUS), min(plane.shape[0], row + RADIUS + 1)):
        blurred = blurred + lanes.load(plane, window_row, first) * window[window_row - row + RADIUS]
    return blurred


@njit(inline="always", fastmath=True)
def _across(half, k, first, window):
    """The window applied along line k of half (column 0 at index MARGIN, zeros on both sides), for sixteen columns."""
    blurred = lanes.zero()
    for tap in range(2 * RADIUS + 1):
        blurred = blurred + lanes.load(half, k, first + (MARGIN - RADIUS) + tap) * window[tap]
    return blurred


@njit(**OPTIONS)
def _blur(plane: F32, window: F32, halves: F32, out: F32) -> None:
    """The separable window over plane [row, col], zeros outside; halves [task, line, col] is scratch with margins."""
    rows, width = plane.shape
    for task in prange(halves.shape[0]):
        half = halves[task]
        for row in range(task * TASK_ROWS, min(rows, (task + 1) * TASK_ROWS)):
            for start in range(0, width, lanes.WIDTH):
                first, _, _ = _columns(start, width, width)
                lanes.store(half, 0, first + MARGIN, _down(plane, row, first, window))
            for start in range(0, width, lanes.WIDTH):
                first, _, _ = _columns(start, width, width)
                lanes.store(out, row, first, _across(half, 0, first, window))


@njit(**OPTIONS)
def _ssim_terms(
    image: F32, target: F32, weights: F32 | None, cols: int, target_blurred: F32, window: F32, c1: float, c2: float,
    halves: F32, partials: F32, sums: NDArray[np.float64],
) -> None:  # fmt: skip
    """Partial derivatives of the SSIM map with respect to the blurred x, x², xy; sums [row] of the map itself.

    With weights the map is w SSIM; if they are None, the kernel is compiled without them.
    """
    one, two, k1, k2 = _f(1), _f(2), _f(c1), _f(c2)
    rows, width = image.shape
    for task in prange(halves.shape[0]):
        half = halves[task]
        for row in range(task * TASK_ROWS, min(rows, (task + 1) * TASK_ROWS)):
            for start in range(0, width, lanes.WIDTH):
                first, _, _ = _columns(start, cols, width)
                bx, bxx, bxy = lanes.zero(), lanes.zero(), lanes.zero()
                for window_row in range(max(0, row - RADIUS), min(rows, row + RADIUS + 1)):
                    x = lanes.load(image, window_row, first)
                    weighted = x * window[window_row - row + RADIUS]
                    bx, bxx = bx + weighted, bxx + weighted * x
                    bxy = bxy + weighted * lanes.load(target, window_row, first)
                lanes.store(half, 0, first + MARGIN, bx)
                lanes.store(half, 1, first + MARGIN, bxx)
                lanes.store(half, 2, first + MARGIN, bxy)
            amount = lanes.zero()
            for start in range(0, width, lanes.WIDTH):
                first, fresh, high = _columns(start, cols, width)
                mx, my = _across(half, 0, first, window), lanes.load(target_blurred[0], row, first)
                # Clamp differences of squares, because rounding must not make them negative or violate Cauchy-Schwarz.
                vx = lanes.clamp(_across(half, 1, first, window) - mx * mx, _f(0), _LARGEST)
                vy = lanes.clamp(lanes.load(target_blurred[1], row, first) - my * my, _f(0), _LARGEST)
                vxy = _across(half, 2, first, window) - mx * my
                low1, low2 = one / (mx * mx + my * my + k1), one / (vx + vy + k2)
                structure = two * lanes.clamp(vxy * low2, _f(-0.5), _f(0.5)) + k2 * low2
                luminance, heavy = (two * mx * my + k1) * low1, low2
                if weights is not None:
                    weight = lanes.load(weights, row, first)
                    structure, heavy = structure * weight, low2 * weight
                value = luminance * structure
                d_vx = lanes.zero() - value * low2
                d_vxy = two * luminance * heavy
                d_mx = two * low1 * (my * structure - mx * value)
                amount = amount + lanes.between(value, fresh, high)
                # Columns that only fill the sixteen lanes are left out of the mean.
                d_x = d_mx - two * mx * d_vx - my * d_vxy
                lanes.store(partials[0], row, first, lanes.between(d_x, 0, high))
                lanes.store(partials[1], row, first, lanes.between(d_vx, 0, high))
                lanes.store(partials[2], row, first, lanes.between(d_vxy, 0, high))
            sums[row] = lanes.total(amount)


@njit(**OPTIONS)
def _combine(
    image: F32, target: F32, weights: F32 | None, cols: int, partials: F32, window: F32, term: DataTerm, share: float,
    ssim: float, halves: F32, gradient: F32, sums: NDArray[np.float64],
) -> None:  # fmt: skip
    """The gradient from the blurred partial derivatives and from the data term; sums [row] of w times that term."""
    rows, width = image.shape
    kind, soft, depth = term.kind, _f(1) / _f(term.delta), -_f(term.depth)
    for task in prange(halves.shape[0]):
        half = halves[task]
        for row in range(task * TASK_ROWS, min(rows, (task + 1) * TASK_ROWS)):
            for start in range(0, width, lanes.WIDTH):
                first, _, _ = _columns(start, cols, width)
                for k in range(3):
                    lanes.store(half, k, first + MARGIN, _down(partials[k], row, first, window))
            amount = lanes.zero()
            for start in range(0, width, lanes.WIDTH):
                first, low, high = _columns(start, cols, width)
                x, y = lanes.load(image, row, first), lanes.load(target, row, first)
                difference = x - y
                if kind == L1:
                    pull = lanes.sign(difference)
                    value = difference * pull
                elif kind == L2:
                    pull = difference * soft
                    value = difference * pull * _f(0.5)
                else:
                    pull = difference * soft * lanes.exp(lanes.clamp(y, _f(0), _LARGEST) * depth)
                    value = difference * pull * _f(0.5)
                slope = _across(half, 0, first, window) + y * _across(half, 2, first, window)
                slope = slope + _f(2) * x * _across(half, 1, first, window)
                if weights is not None:
                    weight = lanes.load(weights, row, first)
                    pull, value, slope = pull * weight, value * weight, slope * lanes.sign(weight)
                amount = amount + lanes.between(value, low, high)
                lanes.store(gradient, row, first, pull * _f(share) - slope * _f(ssim))
            sums[row] = lanes.total(amount)


class CpuProjectionLoss:
    """mean D(x, y) + λ (1 - SSIM(x, y)) and its gradient, for many images x against few targets y; D a `DataTerm`.

    Two passes over the rows: blurs of x, x², xy and the SSIM map's partial derivatives; blurs of these and the
    gradient. Each task takes a few rows and blurs them first down, then along one line that stays in its cache. The
    target's blurred maps do not change during a fit, so they are computed once per view.

    With weights w [row, col] >= 0 it is mean w (D(x, y) + λ (1 - SSIM(m x, m y))), m = 1 where w > 0 and 0 elsewhere.
    In the windows of SSIM a pixel with weight 0 counts as outside the image, and its gradient is exactly 0. The mean is
    over all pixels, so that a ray has the same influence in a masked projection as in a complete one.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        ssim_weight: float,
        c1: float = 0.01**2,
        c2: float = 0.03**2,
        term: DataTerm = ABSOLUTE,
    ) -> None:
        rows, self._cols = shape
        self.ssim_weight, self.c1, self.c2, self.term = ssim_weight, c1, c2, term
        self.window = gaussian_window()
        # The kernels process sixteen columns at a time, so narrower images get columns of zeros on the right.
        self._width = max(self._cols, lanes.WIDTH)
        self._halves = np.zeros((-(-rows // TASK_ROWS), 3, self._width + 2 * MARGIN), np.float32)
        self._partials = np.empty((3, rows, self._width), np.float32)
        self._sums = np.empty(rows, np.float64)
        self._gradient = np.empty((rows, self._width), np.float32)

    def _padded(self, image: F32) -> F32:
        if image.shape[1] == self._width:
            return np.ascontiguousarray(image)
        padded_image = np.zeros((image.shape[0], self._width), np.float32)
        padded_image[:, : self._cols] = image
        return padded_image

    def target_maps(self, target: F32, weights: F32 | None = None) -> F32:
        """Blurred m y and m y² of a target image, [2, row, col] with at least sixteen columns."""
        wide = self._padded(target if weights is None else target * (weights > 0))
        out = np.empty((2, *wide.shape), np.float32)
        for plane, blurred in zip((wide, wide * wide), out, strict=True):
            _blur(plane, self.window, self._halves, blurred)
        return out

    def __call__(
        self, image: F32, target: F32, target_maps: F32, weights: F32 | None = None
    ) -> tuple[float, F32]:  # fmt: skip
        """The loss, and its derivative with respect to `image` [row, col], which the next call may overwrite.

        `target_maps` must have the same weights. Image and target must be finite also where the weight is 0.
        """
        pixels = image.size
        wide_image, wide_target, cols = self._padded(image), self._padded(target), self._cols
        weight_image, masked_image = None, wide_image
        if weights is not None:
            weight_image = self._padded(weights)
            masked_image = wide_image * (weight_image > 0)
        _ssim_terms(
            masked_image, wide_target, weight_image, cols, target_maps, self.window, self.c1, self.c2, self._halves,
            self._partials, self._sums,
        )  # fmt: skip
        ssim = float(self._sums.sum()) / pixels
        mean_weight = 1.0 if weights is None else float(weights.mean(dtype=np.float64))
        ssim_weight = self.ssim_weight / pixels
        _combine(
            wide_image, wide_target, weight_image, cols, self._partials, self.window, self.term, 1.0 / pixels,
            ssim_weight, self._halves, self._gradient, self._sums,
        )  # fmt: skip
        loss = float(self._sums.sum()) / pixels + self.ssim_weight * (mean_weight - ssim)
        return loss, np.ascontiguousarray(self._gradient[:, :cols])


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
