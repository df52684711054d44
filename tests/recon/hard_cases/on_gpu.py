"""Where the hard cases run on the Triton kernels: on CUDA where there is one, else interpreted and small."""

from __future__ import annotations

import numpy as np
import pytest

from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.splatting.gaussians import Gaussians
from tests.recon.kernels.gpu.on_gpu import DEVICE as DEVICE
from tests.recon.kernels.gpu.on_gpu import EXACT as EXACT

SHAPE, PITCH = (11, 13), 0.5  # no multiple of a tile
BEAMS = {
    "parallel": Geometry.parallel([0.7], SHAPE, pixel_pitch=PITCH, axis_col=5.3),
    "leaning": Geometry.parallel([2.5], SHAPE, pixel_pitch=PITCH, axis_col=5.3, axis_row=4.0, roll=0.2, tilt=-0.3),
    "cone": Geometry.cone([-4.0], SHAPE, 0.8, 25.0, 40.0, axis_col=5.3).about([(0.5, -0.3, 0.4)]),
}
GRID = Grid((5, 6, 9), 0.6, centre=(0.4, -0.8, 1.1))
FAR = 30.0  # px: no pixel is farther from the middle of the detector, or from a centre in it
Shape = tuple[float, float, float]

# The interpreter is numpy, which warns of an infinity that a GPU just makes.
quiet = pytest.mark.filterwarnings("ignore::RuntimeWarning")


def some(shape: Shape, n: int = 8, extent: float = 3.0, seed: int = 1) -> Gaussians:
    """n Gaussians of one shape, in any orientation."""
    rng = np.random.default_rng(seed)
    means = (rng.random((n, 3)) - 0.5) * extent
    return Gaussians.from_physical(
        means, np.tile(shape, (n, 1)), rng.uniform(0.2, 1, n), rng.normal(size=(n, 4)), density_unit=0.7
    )


def at(places: list[Shape], sigma: float, density: float = 0.8) -> Gaussians:
    """Slightly different, slightly turned Gaussians at (x, y, z)."""
    n = len(places)
    rng = np.random.default_rng(5)
    shapes = sigma * rng.uniform(0.7, 1.4, (n, 3))
    return Gaussians.from_physical(places, shapes, np.full(n, density), rng.normal(size=(n, 4)))
