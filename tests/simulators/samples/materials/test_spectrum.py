"""Spectra: energies and weights of a beam, and few energies in place of many."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray

from simulators.light import Beam, Tube
from simulators.samples.materials.spectrum import Attenuation, Spectrum, fewer, light

Reals = NDArray[np.float64]


def _smooth(energies: ArrayLike) -> Reals:
    """A photoelectric-like material: 2/mm at 10 keV."""
    return 2.0 * (np.asarray(energies) / 10.0) ** -3.0


def _step(energies: ArrayLike) -> Reals:
    return np.where(np.asarray(energies) < 10.0, 1.0, 6.0)


def _no_filters(name: str) -> Attenuation:
    raise AssertionError(f"nobody named {name}")


def _light(beam: Beam, *materials: Attenuation, thickness: float = 1.0) -> Spectrum:
    return light(beam, materials or (_smooth,), thickness, _no_filters)


def test_one_energy_is_one_energy() -> None:
    spectrum = _light(Beam(1.0, energy_kev=8.3485))
    assert (spectrum.energies.tolist(), spectrum.weights.tolist()) == ([8.3485], [1.0])
    assert spectrum.mean(_smooth) == _smooth(8.3485)


def test_harmonics_take_their_share_of_the_light() -> None:
    spectrum = _light(Beam(1.0, energy_kev=8.0, harmonics={3: 0.01, 2: 0.002}))
    np.testing.assert_array_equal(spectrum.energies, [8.0, 24.0, 16.0])
    np.testing.assert_allclose(spectrum.weights, [0.988, 0.01, 0.002], rtol=1e-12)


def test_a_table_is_used_unchanged_without_energies_of_zero_weight() -> None:
    spectrum = _light(Beam(1.0, spectrum=((20.0, 1.0), (25.0, 0.0), (30.0, 3.0))))
    assert (spectrum.energies.tolist(), spectrum.weights.tolist()) == ([20.0, 30.0], [0.25, 0.75])


@pytest.mark.parametrize(("material", "most"), [(_smooth, 5), (_step, 5)])
def test_a_pink_beam_has_the_nodes_that_its_sample_needs(material: Attenuation, most: int) -> None:
    """Against a sum over 200 001 energies; a smooth material needs few, a step in the line two and the thin limit."""
    beam = Beam(1.0, energy_kev=10.0, bandwidth=0.02)
    spectrum = _light(beam, material)
    sigma = 10.0 * 0.02 / math.sqrt(8 * math.log(2))
    fine = 10.0 + sigma * np.linspace(-6, 6, 200_001)
    exact = Spectrum.of(fine, np.exp(-((fine - 10.0) ** 2) / (2 * sigma**2)))
    t = np.array([0.01, 0.1, 0.5, 1.0])
    worst = 2e-5 if material is _smooth else 4e-3  # half a node's weight
    np.testing.assert_allclose(spectrum.transmission(material, t), exact.transmission(material, t), atol=worst)
    assert spectrum.energies.size <= most


def test_a_long_table_is_reduced_to_the_energies_that_the_sample_needs() -> None:
    energies = np.linspace(10, 60, 400)
    table = tuple(zip(energies.tolist(), (1 + np.sin(energies / 7)).tolist(), strict=True))
    spectrum = _light(Beam(1.0, spectrum=table), thickness=5.0)
    t = np.geomspace(1e-3, 5, 30)
    exact = Spectrum.of(energies, 1 + np.sin(energies / 7)).transmission(_smooth, t)
    np.testing.assert_allclose(spectrum.transmission(_smooth, t), exact, atol=1e-5)
    assert spectrum.energies.size < 15


def test_a_tube_is_kramers_behind_its_filter() -> None:
    """Against a sum over 1/E - 1/kV, filtered, on 100 000 energies; a filter hardens."""
    means = []
    for mm in (0.5, 2.0):
        beam = Beam(1.0, tube=Tube(60.0, {"it": mm}))
        spectrum = light(beam, [_smooth], 5.0, lambda name: {"it": _smooth}[name])
        fine = np.linspace(1.0, 60.0, 100_001)
        exact = Spectrum.of(fine, (1 / fine - 1 / 60.0) * np.exp(-mm * _smooth(fine)))
        t = np.geomspace(0.01, 5, 8)
        np.testing.assert_allclose(spectrum.transmission(_smooth, t), exact.transmission(_smooth, t), atol=2e-5)
        assert spectrum.energies.size < 15
        assert spectrum.energies.max() < 60.0
        means.append(spectrum.mean(_smooth))
    assert means[1] < means[0]


def test_light_that_is_not_there_is_refused() -> None:
    with pytest.raises(ValueError, match="energy_kev"):
        _light(Beam(1.0))
    with pytest.raises(ValueError, match=r"tube's 60"):
        light(Beam(1.0, tube=Tube(60.0, {"it": 1e6})), [_smooth], 1.0, lambda name: _smooth)


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


def test_one_attenuation_needs_one_energy() -> None:
    kept, weights = fewer(np.full((40, 1), 2.0), np.full(40, 1 / 40), 1.0, 1e-9)
    assert (kept.size, weights.tolist()) == (1, [1.0])


def test_energies_that_all_matter_are_all_kept() -> None:
    attenuation, weights = np.array([[0.01], [1.0], [100.0], [1e4]]), np.array([0.1, 0.2, 0.3, 0.4])
    kept, found = fewer(attenuation, weights, 1.0, 1e-9)
    np.testing.assert_array_equal(kept, [0, 1, 2, 3])
    np.testing.assert_allclose(found, weights, atol=1e-6)
