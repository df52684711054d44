"""A can with balls at known positions, to test the count of particles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

SHAPE = (40, 72, 72)
MATRIX, WALL, BALL = 0.2, 1.0, 2.0
# Centre (z, y, x) and radius in voxels; the last two touch, the one before lies outside the square in the can.
BALLS = (
    ((10.0, 30.3, 28.0), 5.0), ((29.5, 40.0, 44.7), 6.3), ((12.0, 45.2, 30.1), 4.1), ((30.0, 26.0, 30.0), 3.2),
    ((20.0, 35.5, 60.0), 4.0), ((12.0, 32.0, 43.0), 5.0), ((12.0, 41.0, 43.0), 4.5),
)  # fmt: skip
CIRCLE = (35.5, 35.5, 32.0)  # centre (y, x) and outer radius of the can


def inside(centre: tuple[float, float, float], radius: float, shape: tuple[int, int, int] = SHAPE) -> NDArray[np.bool_]:
    """Voxels whose centre lies in a ball."""
    z, y, x = np.ogrid[: shape[0], : shape[1], : shape[2]]
    return (z - centre[0]) ** 2 + (y - centre[1]) ** 2 + (x - centre[2]) ** 2 <= radius**2


def can(noise: float = 0.1, blur: float = 0.6) -> NDArray[np.float32]:
    """Attenuation [z, y, x] of the can with its balls, blurred, with noise."""
    y, x = np.ogrid[: SHAPE[1], : SHAPE[2]]
    from_axis = np.hypot(y - CIRCLE[0], x - CIRCLE[1])
    plane = np.where(from_axis <= CIRCLE[2], np.where(from_axis > CIRCLE[2] - 3, WALL, MATRIX), 0.0)
    volume = np.broadcast_to(plane, SHAPE).copy()
    for centre, radius in BALLS:
        volume[inside(centre, radius)] = BALL
    volume = ndimage.gaussian_filter(volume, blur)
    return (volume + noise * np.random.default_rng(5).standard_normal(SHAPE)).astype(np.float32)
