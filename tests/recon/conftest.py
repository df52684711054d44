"""Small random sets of Gaussians, shared by the tests of the splatting engine."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from recon.base.kernel import Kernel
from recon.splatting.gaussians import Gaussians

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
