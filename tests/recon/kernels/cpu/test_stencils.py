"""Sums over neighbours in the plane: compared with SciPy's correlation."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import correlate

from recon.kernels.cpu.stencils import weighted_sum


def test_the_sum_is_a_correlation_with_the_edge_repeated(rng: np.random.Generator) -> None:
    x, stencil = rng.standard_normal((9, 7, 5)).astype(np.float32), rng.standard_normal((5, 3)).astype(np.float32)
    stencil[1, 2] = 0
    out = np.empty_like(x)
    weighted_sum(x, stencil, out)
    np.testing.assert_allclose(out, correlate(x, stencil[..., None], mode="nearest"), atol=1e-5)
