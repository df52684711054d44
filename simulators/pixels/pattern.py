"""Fixed pattern: differences between the sensor's pixels that are the same in all frames, from a hash of (effect,
seed, row, column).

Only the pixels of the frame are computed; they are the same for any ROI and binning.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from drivers.orca_quest import SENSOR_SHAPE
from recon.base.jit import njit
from simulators.frame.shot import Image, Shot, fixed_rng
from simulators.pixels.bands import share_rows

STEP = np.uint64(0x9E3779B97F4A7C15)
"""Odd, 2^64 over the golden ratio: the states of a stream are this far apart."""
_FIRST, _SECOND = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_30, _27, _31, _11, _8 = (np.uint64(n) for n in (30, 27, 31, 11, 8))
_SIGN, _LAYER = np.uint64(256), np.uint64(255)

TAIL = 3.6541528853610088
"""The number at which the tail of the ziggurat begins, for 256 layers (Marsaglia & Tsang 2000)."""


def layers() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Edges x [257] of layers of equal area, falling from the edge of the base to 0, and exp(-x²/2) [257]."""
    area = TAIL * math.exp(-(TAIL**2) / 2) + math.sqrt(math.pi / 2) * math.erfc(TAIL / math.sqrt(2))
    edges = [area * math.exp(TAIL**2 / 2), TAIL]
    while len(edges) < 256:
        edges.append(math.sqrt(-2 * math.log(area / edges[-1] + math.exp(-(edges[-1] ** 2) / 2))))
    x = np.array([*edges, 0.0])
    return x, np.exp(-(x**2) / 2)


_X, _HEIGHT = layers()


@njit(cache=True, nogil=True, inline="always")
def mix(state):
    """Hash of 64 bits to 64 bits, one to one."""
    z = (state ^ (state >> _30)) * _FIRST
    z = (z ^ (z >> _27)) * _SECOND
    return z ^ (z >> _31)


@njit(cache=True, nogil=True, inline="always")
def begin(key, number):
    """State of the stream `number` (a row, a pixel) among the streams of a key."""
    return mix(key ^ mix(np.uint64(number) * STEP + STEP))


@njit(cache=True, nogil=True, inline="always")
def uniform(state):
    """A number in 0 ... 1 (excluded) with 53 bits, and the state after it."""
    state += STEP
    return (mix(state) >> _11) * 2.0**-53, state


@njit(cache=True, nogil=True)
def normal(state):
    """A number of mean 0 and variance 1 and the state after it. Ziggurat of Marsaglia & Tsang (2000), with separate
    bits for layer, sign and value (Doornik 2005)."""
    while True:
        state += STEP
        bits = mix(state)
        layer = bits & _LAYER
        x = (bits >> _11) * 2.0**-53 * _X[layer]
        if x >= _X[layer + np.uint64(1)]:
            if layer == 0:
                y = 0.0
                while 2.0 * y <= (x - TAIL) * (x - TAIL):
                    u, state = uniform(state)
                    v, state = uniform(state)
                    x = TAIL - math.log(1.0 - u) / TAIL
                    y = -math.log(1.0 - v)
            else:
                u, state = uniform(state)
                low, high = _HEIGHT[layer], _HEIGHT[layer + np.uint64(1)]
                if low + u * (high - low) >= math.exp(-0.5 * x * x):
                    continue
        return (-x if bits & _SIGN else x), state


@njit(cache=True, nogil=True)
def _normal_rows(key, first, end, row0, col0, out):  # pragma: no cover
    for row in range(first, end):
        of_row = begin(key, row0 + row)
        for col in range(out.shape[1]):
            out[row, col], _ = normal(mix(of_row + np.uint64(col0 + col) * STEP))


def normals(effect: str, seed: int, shot: Shot) -> Image:
    """A normal number (mean 0, variance 1) of each sensor pixel of the ROI, float64 [row, col], unbinned."""
    row0, col0, rows, cols = shot.roi
    key, out = fixed_rng(effect, seed).integers(2**64, dtype=np.uint64), np.empty((rows, cols))
    share_rows(lambda first, end: _normal_rows(key, first, end, row0, col0, out), out.shape)
    return out


def binned(pixels: Image, binning: int) -> Image:
    """Sums over binning x binning sensor pixels."""
    if binning == 1:
        return pixels
    rows, cols = (n // binning for n in pixels.shape)
    return pixels.reshape(rows, binning, cols, binning).sum(axis=(1, 3))


def places(
    effect: str, seed: int, fraction: float, shot: Shot
) -> tuple[tuple[NDArray[np.int64], NDArray[np.int64]], NDArray[np.float64]]:
    """The sensor pixels of the frame among a random `fraction` of all sensor pixels.

    Returns:
        Their (rows, columns) in the frame, and for each a uniform number in 0 ... 1. A binned pixel occurs as often
        as it contains such pixels.
    """
    rng = fixed_rng(effect, seed)
    n = round(fraction * SENSOR_SHAPE[0] * SENSOR_SHAPE[1])
    drawn, first = np.unique(rng.integers(SENSOR_SHAPE[0] * SENSOR_SHAPE[1], size=n), return_index=True)
    value = rng.random(n)[first]
    rows, cols = np.divmod(drawn, SENSOR_SHAPE[1])
    row0, col0, height, width = shot.roi
    inside = (rows >= row0) & (rows < row0 + height) & (cols >= col0) & (cols < col0 + width)
    return ((rows[inside] - row0) // shot.binning, (cols[inside] - col0) // shot.binning), value[inside]
