"""Materials: the tables themselves, published values of others, and mixtures by hand."""

from __future__ import annotations

import numpy as np
import pytest
import xraylib
from hypothesis import given
from hypothesis import strategies as st

from simulators.samples.materials.materials import Material, by_mass, by_volume, layered_oxide, of_formula

ENERGIES = np.array([2.0, 8.0, 8.5, 25.0, 60.0, 300.0])

# NIST, Hubbell & Seltzer, NISTIR 5632 (XCOM's data): total mass attenuation with coherent scattering, cm2/g.
PUBLISHED = [
    ("Al", 10.0, 26.23),
    ("Al", 20.0, 3.441),
    ("Al", 60.0, 0.2778),
    ("Cu", 10.0, 215.9),
    ("Cu", 20.0, 33.79),
    ("Si", 10.0, 33.89),
    ("Fe", 20.0, 25.68),
    ("Fe", 100.0, 0.3717),
    ("Ni", 10.0, 209.0),
    ("C", 10.0, 2.373),
    ("Pb", 100.0, 5.549),
    ("H2O", 10.0, 5.329),
    ("H2O", 20.0, 0.8096),
]


@pytest.mark.parametrize(("formula", "energy", "expected"), PUBLISHED)
def test_published_values_agree(formula: str, energy: float, expected: float) -> None:
    """To 0.1 %: XCOM and xraylib take photoabsorption from the same calculations and interpolate each in their way."""
    got = of_formula("it", formula, 2.5).attenuation(energy) / (0.1 * 2.5)
    assert float(got) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(("formula", "density"), [("LiCoO2", 5.05), ("LiNi0.8Mn0.1Co0.1O2", 4.78), ("C3H6", 0.9)])
def test_attenuation_is_the_table_times_the_density(formula: str, density: float) -> None:
    expected = [0.1 * density * xraylib.CS_Total_CP(formula, e) for e in ENERGIES.tolist()]
    material = of_formula("it", formula, density)
    np.testing.assert_allclose(material.attenuation(ENERGIES), expected, rtol=1e-12)
    np.testing.assert_array_equal(material.attenuation(ENERGIES.reshape(2, 3)).ravel(), material.attenuation(ENERGIES))


@given(st.dictionaries(st.sampled_from(["H2O", "LiPF6", "Fe", "C2H4"]), st.floats(0.01, 10), min_size=1))
def test_a_mixture_by_mass_is_the_mean_of_its_parts(parts: dict[str, float]) -> None:
    total = sum(parts.values())
    expected = sum(mass / total * of_formula(f, f, 3.0).attenuation(ENERGIES) for f, mass in parts.items())
    np.testing.assert_allclose(by_mass("mix", 3.0, parts).attenuation(ENERGIES), expected, rtol=1e-12)


def test_a_mixture_by_volume_attenuates_as_two_layers_do() -> None:
    film, pores = of_formula("film", "C3H6", 0.9), of_formula("pores", "H2O", 1.0)
    both = by_volume("both", film, pores, 0.6)
    assert both.density == pytest.approx(0.94)
    layers = 0.6 * film.attenuation(ENERGIES) + 0.4 * pores.attenuation(ENERGIES)
    np.testing.assert_allclose(both.attenuation(ENERGIES), layers, rtol=1e-12)


def test_a_layered_oxide_has_its_crystal_s_density() -> None:
    """LiCoO2: three formula units of 97.87 g/mol in 96.5 A3 are 5.05 g/cm3."""
    assert layered_oxide("LCO", "LiCoO2", 2.8166, 14.052).density == pytest.approx(5.05, abs=0.005)


def test_a_charged_oxide_is_the_table_far_from_its_edges() -> None:
    """The docstring's statement on lithium holds, too."""
    plain = of_formula("LCO", "LiCoO2", 5.05)
    charged = Material("LCO", 5.05, plain.fractions, state_of_charge=0.7)
    np.testing.assert_array_equal(charged.attenuation(ENERGIES), plain.attenuation(ENERGIES))
    assert (charged.attenuation(7.729) / plain.attenuation(7.729)) > 1.2
    lithium = dict(plain.fractions)[3] * xraylib.CS_Total(3, 7.6) * 0.1 * 5.05
    assert lithium < 2e-3 * plain.attenuation(7.6)


def test_the_shift_of_the_edge_may_be_named() -> None:
    nmc = of_formula("NMC", "LiNi0.8Mn0.1Co0.1O2", 4.78)
    e = np.arange(8.330, 8.360, 1e-5)
    tops = [
        e[np.argmax(Material("NMC", 4.78, nmc.fractions, charge, shift).attenuation(e))]
        for charge, shift in ((1.0, 4.0), (0.5, 4.0), (0.0, 4.0), (0.0, None))
    ]
    np.testing.assert_allclose(tops, [8.3485, 8.3465, 8.3445, 8.3465], atol=5e-5)


@pytest.mark.parametrize(
    ("density", "charge", "shift", "words"),
    [
        (0.0, None, None, "density must lie between 0 and 100 g/cm3, got 0.0"),
        (5.0, 1.5, None, r"state_of_charge must lie in 0 ... 1, got 1.5"),
        (5.0, 0.5, None, "an oxide with Mn, Co, Ni; this has none of them"),
        (5.0, 0.5, 20.5, r"edge_shift_ev must lie in -20 ... 20 eV, got 20.5"),
        (5.0, 0.5, -400.0, "edge_shift_ev must lie in"),
        (5.0, None, 2.0, "edge_shift_ev needs a state_of_charge"),
    ],
)
def test_impossible_materials_are_refused(
    density: float, charge: float | None, shift: float | None, words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        Material("it", density, ((13, 1.0),), charge, shift)


def test_unknown_formulas_and_untabulated_energies_are_refused() -> None:
    with pytest.raises(ValueError, match="unknown symbol Xx"):
        of_formula("it", "Xx2O", 1.0)
    with pytest.raises(ValueError, match=r"from 0.1 to 800"):
        of_formula("it", "Al", 2.7).attenuation([8.0, 900.0])
