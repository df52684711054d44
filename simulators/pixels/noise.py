"""Noise: exact Poisson and normal noise of a frame, row by row; each row has its own random stream.

A Poisson number is the quantile C⁻¹(Φ(w)) of a normal number w, where C is Poisson's cumulative distribution. No number
is rejected, so rows can be vectorised. The quantile is the integer part of an expansion in 1 / √λ (Giles 2016,
"Algorithm 955"). The expansion may be closer to a whole number than its error. In this case (one in thousands), the
distribution itself is summed. For expectations below 2 a uniform number is looked up in the distribution.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from recon.base.jit import njit
from simulators.frame.shot import CannotExposeError
from simulators.pixels.bands import share_rows
from simulators.pixels.pattern import STEP, begin, mix, normal

LEAST = 2.0
"""Least expectation for the expansion. Below it, a uniform number is looked up in the distribution from 0 up."""
EASY = 8
"""Numbers up to this one are compared in a vectorised loop. For small expectations, 2 in 10 000 are larger."""
LARGEST = 1e9
"""Largest expectation: rounding of the expansion is far below its error up to there."""


@njit(cache=True, nogil=True, inline="always")
def expansion(w, mean, root):
    """x with Q(x, mean) = Φ(w), and a bound of its error. Q is the regularised upper incomplete gamma function; the
    Poisson quantile is the integer part of x; `root` is √mean. The bound is twice the bound of Giles for |w| <= 3 (for
    |w| <= 5 from an expectation of 30 on); there is no bound for other w."""
    s = 1.0 / root
    ww = w * w
    x = mean + root * w + (1 / 3 + ww / 6) - s * w * (1 / 36 + ww / 72)
    x += s * s * (-8 / 405 + ww * (7 / 810 + ww / 270))
    close = (mean >= LEAST) & (ww <= (9.0 if mean < 30.0 else 25.0))
    return x, s * s * s * (1 / 20 + ww * (1 / 40 + ww / 80)) if close else math.inf


@njit(cache=True, nogil=True)
def summed(w, mean):
    """The Poisson quantile of Φ(w) by the sum of the distribution, from its nearer end. The sum is over the lower tail
    for w < 0 and over the upper tail for w > 0, so that no digits are lost; `mean` >= LEAST."""
    tail = 0.5 * math.erfc(abs(w) / math.sqrt(2.0))
    k = max(int(expansion(w, mean, math.sqrt(mean))[0]), 0)
    share = math.exp(k * math.log(mean) - mean - math.lgamma(k + 1.0))
    if w < 0:  # the least k with P(K <= k) > Φ(w)
        lower, term, j = share, share, k
        while j > 0 and term > 1e-17 * lower:
            term *= j / mean
            j -= 1
            lower += term
        while k > 0 and lower - share > tail:
            lower -= share
            share *= k / mean
            k -= 1
        while lower <= tail:
            k += 1
            share *= mean / k
            lower += share
    else:  # the least k with P(K > k) < Φ(-w)
        upper, term, j = 0.0, share, k
        while term > 1e-17 * upper:
            j += 1
            term *= mean / j
            upper += term
        while k > 0 and upper + share < tail:
            upper += share
            share *= k / mean
            k -= 1
        while upper >= tail:
            k += 1
            share *= mean / k
            upper -= share
    return float(k)


@njit(cache=True, nogil=True)
def searched(u, mean):
    """The Poisson quantile of u in 0 ... 1 by sums from 0 up, for small expectations."""
    k, share = 0, math.exp(-mean)
    while u >= share and share > 0.0:
        u -= share
        k += 1
        share *= mean / k
    return float(k)


@njit(cache=True, nogil=True, error_model="numpy")
def _poisson_rows(key, first, end, image):  # pragma: no cover
    """Replaces image[row, col] by a Poisson number with this expectation, for the rows of a band."""
    cols = image.shape[1]
    w, u, k = np.empty(cols), np.empty(cols), np.empty(cols)
    for row in range(first, end):
        mean = image[row]
        state, few = begin(key, row), False
        for col in range(cols):
            few |= mean[col] < LEAST
            w[col], state = normal(state)
        for col in range(cols):  # vectorised: no branch, no call
            m = mean[col]
            x, error = expansion(w[col], m, math.sqrt(m))
            low = math.floor(x - error)
            k[col] = low if low == math.floor(x + error) else -1.0
        if few:
            _small(state, mean, u, k)
        for col in range(cols):
            if k[col] < 0.0:
                k[col] = summed(w[col], mean[col]) if mean[col] >= LEAST else searched(u[col], mean[col])
            mean[col] = k[col]


@njit(cache=True, nogil=True)
def _small(state, mean, u, k):  # pragma: no cover
    """Draws uniform numbers u [col] and sets k [col] to their quantiles for the small expectations of a row, or to -1
    where the quantile exceeds EASY. Other columns of k are unchanged."""
    share = np.empty(mean.size)
    for col in range(mean.size):
        share[col] = math.exp(-mean[col])
    for col in range(mean.size):  # vectorised
        u[col] = (mix(state + np.uint64(col + 1) * STEP) >> np.uint64(11)) * 2.0**-53
        m, part, total, n = mean[col], share[col], share[col], 0.0
        for j in range(1, EASY + 1):
            n += 1.0 if u[col] >= total else 0.0
            part *= m * (1.0 / j)
            total += part
        n = -1.0 if u[col] >= total else n
        k[col] = n if m < LEAST else k[col]


@njit(cache=True, nogil=True)
def _normal_rows(key, first, end, rms, stride, image):  # pragma: no cover
    """Add rms * normal. In rms [pixel] each row begins `stride[0]` further and each column `stride[1]`."""
    for row in range(first, end):
        state = begin(key, row)
        for col in range(image.shape[1]):
            value, state = normal(state)
            image[row, col] += rms[row * stride[0] + col * stride[1]] * value


def poisson(image: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Replaces expectations [row, col] by Poisson numbers in place, and returns them.

    Args:
        rng: one number drawn from it is the key of all rows' streams.

    Raises:
        CannotExposeError: an expectation is negative, not a number or beyond LARGEST; the image is unchanged.
    """
    low, high = image.min(initial=0.0), image.max(initial=0.0)
    if not (low >= 0 and high <= LARGEST):
        raise CannotExposeError(
            f"Poisson noise: expected values must be 0 ... {LARGEST:g}, got {low:g} ... {high:g} photons "
            "or electrons per pixel; use a weaker beam or a shorter exposure"
        )
    key = rng.integers(2**64, dtype=np.uint64)
    share_rows(lambda first, end: _poisson_rows(key, first, end, image), image.shape)
    return image


def add_normal(image: NDArray[np.float64], rms: NDArray[np.float64] | float, rng: np.random.Generator) -> None:
    """Add normal noise to `image` [row, col]; `rms` is a number or has the image's shape."""
    key, each = rng.integers(2**64, dtype=np.uint64), np.asarray(rms, dtype=np.float64).reshape(-1)
    stride = (0, 0) if each.size == 1 else (image.shape[1], 1)
    share_rows(lambda first, end: _normal_rows(key, first, end, each, stride, image), image.shape)
