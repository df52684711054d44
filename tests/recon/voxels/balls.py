"""Balls with known line integrals, which may move during the scan: an independent check without voxels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def ball_views(
    angles: NDArray[np.float64],
    shape: tuple[int, int],
    turn: NDArray[np.float64] | float = 0.0,
    shift: Sequence[NDArray[np.float64] | float] = (0.0, 0.0, 0.0),
    seed: int = 0,
    count: int = 25,
) -> NDArray[np.float32]:
    """Projections [view, row, col] of balls around the axis in the middle of the detector, with pixels of size 1.

    Args:
        turn, shift: radians, and pixels (x, y, z) on the stage, for each projection: the sample is first rotated, then
            shifted.
    """
    rng = np.random.default_rng(seed)
    rows, cols = shape
    radius, where = 0.36 * cols * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    x, y, z = radius * np.cos(where), radius * np.sin(where), (rng.random(count) - 0.5) * rows
    size, mu = rng.uniform(1.5, 4, count), rng.uniform(0.05, 0.15, count)
    theta = np.asarray(angles)[:, None]
    turned = theta + np.broadcast_to(np.asarray(turn, float).reshape(-1, 1), theta.shape)
    dx, dy, dz = (np.broadcast_to(np.asarray(s, float).reshape(-1, 1), theta.shape) for s in shift)
    u = x * np.cos(turned) + y * np.sin(turned) + dx * np.cos(theta) + dy * np.sin(theta)
    v = z + dz
    fine = (np.arange(2) + 0.5) / 2 - 0.5  # a pixel is the mean of four rays
    out = np.zeros((len(theta), rows, cols))
    for a in fine:
        for b in fine:
            across = np.arange(cols) - (cols - 1) / 2 + a - u[:, :, None]
            down = np.arange(rows) - (rows - 1) / 2 + b - v[:, :, None]
            left = size[:, None, None] ** 2 - down[:, :, :, None] ** 2 - across[:, :, None, :] ** 2
            out += np.einsum("k,vkrc->vrc", mu / 2, np.sqrt(np.maximum(left, 0)))
    return out.astype(np.float32)
