"""Effective depth: beam hardening in closed form, its bounds, and rays of all depths."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from simulators.samples.materials.parts import effective_depth
from simulators.samples.materials.spectrum import Spectrum

Reals = NDArray[np.float64]


def test_a_slab_in_two_energies_is_the_closed_form() -> None:
    """-log(w exp(-a t) + (1-w) exp(-b t)): slope w a + (1-w) b where it is thin, and the harder of both in the end."""
    spectrum = Spectrum.of([20.0, 30.0], [3.0, 1.0])
    mu = np.array([[4.0], [1.0]])
    t = np.geomspace(1e-6, 1e3, 50).reshape(1, 5, 10)
    got = effective_depth(t, mu, spectrum.weights)
    expected = -np.logaddexp(np.log(0.75) - 4 * t[0], np.log(0.25) - t[0])
    np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-13)  # of the open beam
    assert got[0, 0] / t[0, 0, 0] == pytest.approx(0.75 * 4 + 0.25 * 1, rel=1e-5)
    assert got[-1, -1] - 1.0 * t[0, -1, -1] == pytest.approx(-math.log(0.25))


@given(
    thickness=arrays(np.float64, (2, 3, 4), elements=st.floats(0, 50)),
    mu=arrays(np.float64, (3, 2), elements=st.floats(-0.5, 60)),
    weights=arrays(np.float64, 3, elements=st.floats(0.01, 1)),
)
def test_the_effective_depth_lies_between_the_least_and_the_mean(thickness: Reals, mu: Reals, weights: Reals) -> None:
    """Jensen: light that is added up never looks deeper than the mean depth; matter of one attenuation is exact."""
    weights = weights / weights.sum()
    depths = np.tensordot(mu, thickness, 1)
    got = effective_depth(thickness, mu, weights)
    slack = 1e-9 * (1 + np.abs(depths).max())
    assert (got <= np.tensordot(weights, depths, 1) + slack).all()
    assert (got >= depths.min(axis=0) - slack).all()
    same = effective_depth(thickness, np.repeat(mu[:1], 3, axis=0), weights)
    np.testing.assert_allclose(same, depths[0], atol=slack)


def test_air_is_exactly_nothing_and_no_matter_is_too_deep() -> None:
    thickness = np.zeros((1, 2, 2))
    thickness[0, 1] = 1e6
    depth = effective_depth(thickness, np.array([[5.0], [4.0]]), np.array([0.3, 0.7]))
    assert (depth[0] == 0).all() and np.isfinite(depth[1]).all()
    gap = np.array([[[1.0, 0.0, 1.0]]])  # between matter, where weights sum up to 1 only to rounding
    assert effective_depth(gap, np.ones((10, 1)), np.full(10, 0.1))[0, 1] == 0.0


def test_many_rows_are_shared_out_and_come_out_the_same() -> None:
    thickness = np.random.default_rng(0).uniform(0, 2, (2, 300, 301))  # more than threads are taken for
    mu, weights = np.array([[3.0, 1.0], [1.0, 2.0]]), np.array([0.4, 0.6])
    expected = -np.log(np.tensordot(weights, np.exp(-np.tensordot(mu, thickness, 1)), 1))
    np.testing.assert_allclose(effective_depth(thickness, mu, weights), expected, rtol=1e-12)
