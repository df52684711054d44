"""Fewer energies: the same light through rays that it was not asked about, and no energy that there was not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import nnls

from simulators.samples.materials.spectrum import fewer

Reals = NDArray[np.float64]


@settings(max_examples=30, deadline=None)
@given(n=st.integers(5, 80), n_materials=st.integers(1, 3), seed=st.integers(0, 10**6), power=st.floats(1.0, 4.0))
@example(n=53, n_materials=2, seed=15296, power=2.3125)  # an edge in each, and ways between them
def test_light_through_any_ray_stays_the_same(n: int, n_materials: int, seed: int, power: float) -> None:
    """To ten times the tolerance along rays between the fitted ones."""
    rng = np.random.default_rng(seed)
    energies = np.linspace(10, 60, n)
    steps = 1 + 5 * (energies[:, None] > rng.uniform(10, 60, n_materials))
    attenuation = rng.uniform(0.1, 50, n_materials) * (energies[:, None] / 20) ** -power * steps
    weights = rng.dirichlet(np.ones(n))
    kept, found = fewer(attenuation, weights, 1.0, 1e-5)
    rays = rng.dirichlet(np.full(n_materials, 0.5), 300) * 10 ** rng.uniform(-4, 0, (300, 1))
    before, after = np.exp(-rays @ attenuation.T) @ weights, np.exp(-rays @ attenuation[kept].T) @ found
    np.testing.assert_allclose(after, before, atol=1e-4)
    assert (found > 0).all() and found.sum() == pytest.approx(1.0)
    assert (np.diff(kept) > 0).all()


def test_a_smooth_spectrum_needs_few() -> None:
    energies = np.linspace(5, 60, 500)
    kept, _ = fewer((energies[:, None] / 20) ** -3.0, np.full(500, 1 / 500), 5.0, 1e-6)
    assert kept.size <= 16


def test_one_attenuation_needs_one_energy() -> None:
    kept, weights = fewer(np.full((40, 1), 2.0), np.full(40, 1 / 40), 1.0, 1e-9)
    assert (kept.size, weights.tolist()) == (1, [1.0])


def test_energies_that_all_matter_are_all_kept() -> None:
    attenuation, weights = np.array([[0.01], [1.0], [100.0], [1e4]]), np.array([0.1, 0.2, 0.3, 0.4])
    kept, found = fewer(attenuation, weights, 1.0, 1e-9)
    np.testing.assert_array_equal(kept, [0, 1, 2, 3])
    np.testing.assert_allclose(found, weights, atol=1e-6)


def test_a_long_table_takes_no_longer_than_its_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Energies are chosen among the hundred or so that are enough, not one after another of all that there are: 4000
    of them, for seven materials, took seven minutes."""
    solved: list[int] = []

    def counted(a: Reals, b: Reals) -> tuple[Reals, float]:
        solved.append(a.shape[1])
        return nnls(a, b)

    monkeypatch.setattr("scipy.optimize.nnls", counted)
    energies = np.linspace(5, 100, 600)
    weights = np.random.default_rng(0).dirichlet(np.ones(600))
    attenuation = np.stack([(energies / 20) ** -3 + 0.02, 8 * (energies / 20) ** -2.7 + 0.1], axis=1)
    kept, found = fewer(attenuation, weights, 5.0, 2e-6)
    assert len(solved) < 80 and kept.size < 40
    rays = np.geomspace(1e-3, 5, 30)[:, None] * np.array([0.7, 0.3])
    expected = np.exp(-rays @ attenuation.T) @ weights
    np.testing.assert_allclose(np.exp(-rays @ attenuation[kept].T) @ found, expected, atol=1e-5)
