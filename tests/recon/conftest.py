"""Small random sets of Gaussians, and a few noisy projections of a sample."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from recon.base.kernel import Kernel
from recon.splatting.gaussians import Gaussians
from simulators.frame.shot import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Cylinder, Ellipsoid
from tests.recon.few_views import ANGLES, PITCH, SHAPE, VIEWS

Make = Callable[..., Gaussians]


@pytest.fixture
def random_gaussians(rng: np.random.Generator) -> Make:
    """make(n, extent, smallest, largest, kernel): n Gaussians in a cube of edge `extent`, any orientation, float32."""

    def make(
        n: int = 40,
        extent: float = 12.0,
        smallest: float = 0.4,
        largest: float = 1.6,
        kernel: Kernel = Kernel.GAUSSIAN,
    ) -> Gaussians:
        return Gaussians.from_physical(
            (rng.random((n, 3)) - 0.5) * extent,
            rng.uniform(smallest, largest, (n, 3)),
            rng.uniform(0.2, 1.0, n),
            rng.normal(size=(n, 4)),
            density_unit=0.7,
            kernel=kernel,
        )

    return make


@pytest.fixture(scope="module")
def phantom() -> Phantom:
    return Phantom.of((Cylinder(1.3, 1.6, 0.4), Ellipsoid((0.4, 0.3, 0.4), 1.0, centre=(0.5, 0.3, 0.1))))


@pytest.fixture(scope="module")
def noisy(phantom: Phantom) -> np.ndarray:
    rng = np.random.default_rng(5)
    detector = Detector(SHAPE, PITCH, VIEWS.axis_col, (SHAPE[0] - 1) / 2)
    clean = np.stack([phantom.line_integrals(a, detector) for a in ANGLES])
    counts = rng.poisson(2e4 * np.exp(-clean))
    return -np.log(np.maximum(counts, 1) / 2e4).astype(np.float32)
