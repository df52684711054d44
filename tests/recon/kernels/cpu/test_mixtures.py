"""Densities kept from falling below zero."""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

from recon.kernels.cpu.mixtures import nonnegative_mix


def test_it_is_the_nearest_mixture_and_the_others_keep_their_bits(rng: np.random.Generator) -> None:
    """Against non-negative least squares, wherever one material alone is below 0."""
    to = np.array([[1.2, 0.9], [0.3, -0.4]])
    back = np.linalg.inv(to)
    z = np.ascontiguousarray((to @ rng.normal(0.4, 0.5, (2, 3000))).astype(np.float32)).reshape(2, 10, 20, 15)
    before = z.copy()
    nonnegative_mix(z, back, to)
    start, found = (back @ each.reshape(2, -1).astype(np.float64) for each in (before, z))
    assert found.min() > -1e-6
    fits = (start >= 0).all(0)
    assert np.array_equal(z.reshape(2, -1)[:, fits], before.reshape(2, -1)[:, fits])
    one_below = (start < 0).sum(0) == 1
    nearest = np.array([nnls(to, to @ each)[0] for each in start.T]).T
    np.testing.assert_allclose(found[:, one_below], nearest[:, one_below], atol=1e-5)
