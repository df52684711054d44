"""Streams: uniform and normal random numbers for compiled loops; the state of a stream is one 64-bit number.

A stream is splitmix64 (Steele, Lea & Flood 2014): the state advances by a fixed step and each number is its hash. So a
row of a frame or a pixel of the sensor gets its own stream by hashing its index. Streams that begin at random places of
a period of 2^64 hardly ever overlap, and then share only a few numbers.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from recon.base.jit import njit

STEP = np.uint64(0x9E3779B97F4A7C15)
"""Odd, 2^64 over the golden ratio: the states of a stream are this far apart."""
_FIRST, _SECOND = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_30, _27, _31, _11, _8 = (np.uint64(n) for n in (30, 27, 31, 11, 8))
_SIGN, _LAYER = np.uint64(256), np.uint64(255)

TAIL = 3.6541528853610088
"""Where the ziggurat's tail begins, for 256 layers (Marsaglia & Tsang 2000)."""


def layers() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Edges x [257], falling from the base's to 0, and exp(-x²/2) [257], of layers of equal area."""
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
    """State of the stream `number` (a row, a pixel) among those of a key."""
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
