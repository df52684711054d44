"""Fan: filters that suppress everything that turns with the stage within the field, and pass other motion.

A point of the sample at the distance r from the axis moves by at most r times the angle's step from view to view. In a
few neighbouring views the sample's line integrals are therefore a sum of patterns, each moving steadily at a speed
between -limit and +limit. In the Fourier domain that is a fan, the "bow tie" of a sinogram (Rattey & Lindgren 1981,
IEEE Trans. ASSP 29:994). With the covariance C of such patterns plus noise, the linear filter that finds a signal s
with the best ratio to both is C^-1 s. (Matched filter; North 1943, Robey et al. 1992, IEEE Trans. AES 28:208). The
sample itself need not be known.

Lengths are cells, times are views.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beamline.core.jit import njit
from beamline.monitor.view import CellValues

Reals = NDArray[np.float64]
REACH = 6  # cells of a window to either side of its middle
FREQUENCIES = 120  # up to Nyquist, over which the covariance is summed
ROUGHNESS = 0.05  # cycles-of-2-pi a cell below which the sample's spectrum is flat; above it falls as its third power
CONSTANT = 1.0  # variance of constant differences: rings, flats that do not fit


@dataclass(frozen=True)
class Clutter:
    """The signals that the filters suppress."""

    speed: float  # cells a view that the sample's fastest point moves
    structure: float  # variance of the sample's line integrals on the scale of the window
    common: float  # variance of changes of a whole row or view, such as the beam's
    noise: float  # variance of a cell's noise


def window(lags: tuple[int, ...]) -> tuple[Reals, Reals]:
    """View and column of each place of a window [lag, 2 REACH + 1], flattened, from its middle."""
    views, cols = np.meshgrid(np.array(lags, float), np.arange(-REACH, REACH + 1.0), indexing="ij")
    return views.ravel(), cols.ravel()


def covariance(lags: tuple[int, ...], clutter: Clutter) -> Reals:
    """Covariance [place, place] of a window: patterns of all speeds in the fan alike, seen by square cells."""
    frequency = (np.arange(FREQUENCIES) + 0.5) / FREQUENCIES * np.pi
    power = np.sinc(frequency / (2 * np.pi)) ** 2 / (frequency**2 + ROUGHNESS**2) ** 1.5
    power /= power.sum()
    views, cols = window(lags)
    later, beside = views[:, None] - views, cols[:, None] - cols
    ages, widths = np.unique(np.abs(later)), np.arange(2 * REACH + 1.0)
    # The mean of cos(f (x - v t)) over speeds |v| <= limit is cos(f x) sinc(f limit t).
    blurred = power * np.sinc(frequency * clutter.speed * ages[:, None] / np.pi)
    table = blurred @ np.cos(frequency[:, None] * widths)
    structure = table[np.searchsorted(ages, np.abs(later)), np.abs(beside).astype(int)]
    return clutter.structure * structure + CONSTANT + clutter.common * (later == 0) + clutter.noise * np.eye(views.size)


@dataclass(frozen=True, eq=False)
class Filters:
    """Filters for several signals."""

    # weights: float32 [signal, lag, column]; on clutter and noise as assumed their output has the variance 1
    weights: CellValues
    strength: Reals  # float64 [signal], output for a signal of amplitude 1
    speeds: Reals  # float64 [signal], cells a view


def filters(lags: tuple[int, ...], clutter: Clutter, signals: Reals, speeds: Reals) -> Filters:
    """Matched filters of `signals` float64 [signal, place]."""
    solved = np.linalg.solve(covariance(lags, clutter), signals.T).T
    strength = np.sqrt(np.einsum("sp,sp->s", signals, solved))
    weights = (solved / strength[:, None]).reshape(len(signals), len(lags), 2 * REACH + 1)
    return Filters(np.ascontiguousarray(weights, np.float32), strength, speeds)


@njit(nogil=True, cache=True, fastmath={"contract", "reassoc"})
def correlate(views, weights, out):
    """out[signal, row, col] of views [lag, row, col]; beyond the frame's edges it goes on as at the edge.

    The taps are written out: the sum then stays in a register, which halves the time.
    """
    signals, lags, _ = weights.shape
    rows, cols = views.shape[1:]
    wide = np.empty(cols + 2 * REACH, np.float32)
    out[:] = 0.0
    for row in range(rows):
        for lag in range(lags):
            wide[:REACH] = views[lag, row, 0]
            for i in range(cols):  # assigning slices would compile numba's check of shapes, which takes seconds
                wide[REACH + i] = views[lag, row, i]
            wide[REACH + cols :] = views[lag, row, cols - 1]
            for signal in range(signals):
                w, target = weights[signal, lag], out[signal, row]
                for i in range(cols):
                    total = w[0] * wide[i] + w[1] * wide[i + 1] + w[2] * wide[i + 2] + w[3] * wide[i + 3]
                    total += w[4] * wide[i + 4] + w[5] * wide[i + 5] + w[6] * wide[i + 6] + w[7] * wide[i + 7]
                    total += w[8] * wide[i + 8] + w[9] * wide[i + 9] + w[10] * wide[i + 10] + w[11] * wide[i + 11]
                    target[i] += total + w[12] * wide[i + 12]
