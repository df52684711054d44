"""Phantom: a cylinder of active water with hot and cold rods, and the counts that a scanner takes of it.

After the image-quality phantom of NEMA NU 4-2008, whose hot rods lie in cold plastic. Lengths in mm.

    mean = efficiency exp(-∫ μ) ∫ activity + scatter + randoms

Line integrals are chords of cylinders: no projector is used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from recon import Geometry, Grid
from splatline_emission.counts import F32

WATER, AIR, TEFLON = 0.0096, 1e-5, 0.0174  # 1/mm at 511 keV: water 0.096 cm²/g, PTFE 0.079 cm²/g at 2.2 g/cm³
HEIGHT = 40.0
_RAYS = (-1 / 3, 0.0, 1 / 3)  # of a pixel, in pixels from its middle along a row


@dataclass(frozen=True)
class Rod:
    """A cylinder along the axis. `activity` and `mu`: over those of what it displaces; `at`: (x, y)."""

    radius: float
    at: tuple[float, float]
    activity: float
    mu: float


def _at(turn: int) -> tuple[float, float]:
    """A sixth of a turn from place to place."""
    return 13 * math.cos(turn * math.pi / 3), 13 * math.sin(turn * math.pi / 3)


RODS = (
    Rod(24.0, (0.0, 0.0), 1.0, WATER),
    *(Rod(radius, _at(turn), 3.0, 0.0) for turn, radius in enumerate((1.5, 2.5, 4.0, 5.5))),
    Rod(5.5, _at(4), -1.0, AIR - WATER),
    Rod(5.5, _at(5), -1.0, TEFLON - WATER),
)


@dataclass(frozen=True)
class Scanner:
    """What a scanner counts, and adds to the counts of the activity.

    Attributes:
        trues: counts of pairs that arrive unscattered, of all lines together.
        scatter, randoms: their counts over the trues. Scatter is a broad blur of the trues, randoms are even.
        scatter_mm: standard deviation of that blur.
        spread: relative standard deviation of the efficiency from pixel to pixel.
    """

    trues: float = 1.5e7
    scatter: float = 0.15
    randoms: float = 0.2
    scatter_mm: float = 12.0
    spread: float = 0.1


def chords(geometry: Geometry, which: str) -> NDArray[np.float64]:
    """Line integrals [view, row, col] of "activity" (1 in the water) or "mu"; means over the rays of a pixel."""
    rows, cols = geometry.detector_shape
    inside = np.abs(geometry.pixel_pitch * (np.arange(rows) - geometry.axis_row)) < HEIGHT / 2
    u = geometry.pixel_pitch * (np.arange(cols)[:, None] + np.array(_RAYS) - geometry.axis_col)
    out = np.zeros((geometry.n_views, rows, cols))
    for view, angle in enumerate(geometry.angles):
        for rod in RODS:
            off = u - rod.at[0] * math.cos(angle) - rod.at[1] * math.sin(angle)
            chord = 2 * np.sqrt(np.maximum(rod.radius**2 - off**2, 0)).mean(axis=1)
            out[view] += getattr(rod, which) * chord * inside[:, None]
    return out


def activity(grid: Grid, fine: int = 4) -> F32:
    """Activity [z, y, x], 1 in the water, by `fine`² points of each voxel."""
    z, y, x = grid.coordinates()
    part = ((np.arange(fine) + 0.5) / fine - 0.5) * grid.voxel_size
    ys, xs = (y[:, None] + part).ravel(), (x[:, None] + part).ravel()
    slice_ = np.zeros((ys.size, xs.size))
    for rod in RODS:
        slice_ += rod.activity * (np.hypot(ys[:, None] - rod.at[1], xs - rod.at[0]) < rod.radius)
    mean = slice_.reshape(y.size, fine, x.size, fine).mean(axis=(1, 3))
    return np.asarray((np.abs(z) < HEIGHT / 2)[:, None, None] * mean, np.float32)


def counts_of(geometry: Geometry, scanner: Scanner, seed: int) -> tuple[F32, dict[str, F32], float]:
    """Counts [view, row, col] drawn from Poisson's law, what their mean holds by the names of `read_counts`, and counts
    per mm of a line of activity 1.
    """
    rng = np.random.default_rng(seed)
    lines, depth = chords(geometry, "activity"), chords(geometry, "mu")
    efficiency = rng.normal(1, scanner.spread, geometry.detector_shape).clip(0.3, 1.7) + np.zeros_like(lines)
    trues = efficiency * np.exp(-depth) * lines
    scale = scanner.trues / float(trues.sum())
    trues *= scale
    sigma = scanner.scatter_mm / geometry.pixel_pitch
    scatter = scanner.scatter * gaussian_filter(trues, (0, sigma, sigma), mode="nearest")
    randoms = efficiency * scanner.randoms * scanner.trues / trues.size
    counts = rng.poisson(trues + randoms + scatter).astype(np.float32)
    sets = {"attenuation": depth, "normalisation": efficiency, "randoms": randoms, "scatter": scatter}
    return counts, {name: values.astype(np.float32) for name, values in sets.items()}, scale
