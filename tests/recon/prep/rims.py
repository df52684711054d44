"""Projections of a can of balls next to air (exact chords), with the phase fringes of propagation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, laplace

from recon.base.arrays import F32
from recon.base.geometry import Geometry

SUB = 3  # rays per pixel, along rows and columns


def views_of_can(
    fringes: float = 0.0,
    *,
    shape: tuple[int, int, int] = (48, 8, 80),
    noise: float = 0.003,
    blur: float = 0.0,
    over: float = 0.8,
    gains: float = 0.0,
    seed: int = 1,
) -> tuple[F32, Geometry]:
    """Line integrals [view, row, col] of a can `over` times as wide as the field of view, and their geometry.

    Args:
        fringes: factor of the Laplacian that is subtracted from the transmission, in pixels²: the square of Paganin's
            length.
        noise: noise of the intensity in a pixel, as a share of the open beam.
        blur: sigma in pixels, of the intensity.
        gains: spread of pixel sensitivities that the flats do not contain.
    """
    n, rows, cols = shape
    rng = np.random.default_rng(seed)
    radius, angles = over * cols / 2, np.arange(n) * np.pi / n
    turns, sizes = rng.uniform(0, 2 * np.pi, 14), rng.uniform(3, 7, 14)
    away = (radius - 10) * np.sqrt(rng.uniform(size=14))
    heights = rng.uniform(0, rows, 14)
    fine = (np.arange(SUB) - (SUB - 1) / 2) / SUB
    u, z = ((np.arange(size)[:, None] + fine).ravel() for size in (cols, rows))
    light = np.empty(shape)
    for view, angle in enumerate(angles):
        x = u - (cols - 1) / 2 - 0.3
        chord = [2 * np.sqrt(np.maximum(r**2 - x**2, 0)) for r in (radius, radius - 2)]
        lines = np.tile(0.03 * (chord[0] - chord[1]) + 0.004 * chord[1], (z.size, 1))
        for turn, r, at, height in zip(turns, sizes, away, heights, strict=True):
            off = (x - at * np.cos(turn + angle)) ** 2 + (z[:, None] - height) ** 2
            lines += 0.05 * 2 * np.sqrt(np.maximum(r**2 - off, 0))
        light[view] = np.exp(-lines).reshape(rows, SUB, cols, SUB).mean((1, 3))
        light[view] = gaussian_filter(
            light[view] - fringes * laplace(light[view], mode="nearest"), blur, mode="nearest"
        )
    light *= 1 + gains * rng.normal(size=shape[1:])
    light += noise * np.sqrt(np.maximum(light, 0)) * rng.normal(size=shape)
    return -np.log(np.maximum(light, 1e-3)).astype(np.float32), _geometry(angles, rows, cols)


def _geometry(angles: NDArray[np.float64], rows: int, cols: int) -> Geometry:
    return Geometry.parallel(angles, (rows, cols), axis_col=(cols - 1) / 2 + 0.3)
