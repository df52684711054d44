"""Materials: tables, edges, and the names of a palette."""

from __future__ import annotations

import numpy as np
import pytest
import xraylib
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from simulators.samples.materials.materials import (
    FAR,
    K_EDGES,
    NEAR,
    Material,
    by_mass,
    by_volume,
    known,
    layered_oxide,
    near_edge,
    of_formula,
    palette_of,
    profile,
)
from tests.refused_calls import refused_calls

ENERGIES = np.array([2.0, 8.0, 8.5, 25.0, 60.0, 300.0])

# NIST, Hubbell & Seltzer, NISTIR 5632 (XCOM's data): total mass attenuation with coherent scattering, cm2/g.
PUBLISHED = [
    ("Al", 10.0, 26.23),
    ("Cu", 20.0, 33.79),
    ("Fe", 100.0, 0.3717),
    ("Ni", 10.0, 209.0),
    ("Pb", 100.0, 5.549),
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


Reals = NDArray[np.float64]
Z = sorted(K_EDGES)


def _table(z: int, energies: Reals) -> Reals:
    return np.array([xraylib.CS_Total(z, float(e)) for e in energies])


def _edge(z: int) -> float:
    return float(xraylib.EdgeEnergy(z, xraylib.K_SHELL))


def _near(z: int, energies: Reals, charge: float = 1.0) -> Reals:
    width = xraylib.AtomicLevelWidth(z, xraylib.K_SHELL) * 1e3
    return near_edge(energies, lambda e: _table(z, e), _edge(z), width, K_EDGES[z], charge)


@pytest.mark.parametrize("z", Z)
@pytest.mark.parametrize("charge", [0.0, 1.0])
def test_the_jump_is_the_table_s(z: int, charge: float) -> None:
    """From far below to far above, to the last bit; across 1e-6 of it is asked for."""
    for away in (FAR, 200.0, 1000.0):
        around = _edge(z) + np.array([-away, away]) * 1e-3
        jump, expected = np.diff(_near(z, around, charge))[0], np.diff(_table(z, around))[0]
        assert jump == pytest.approx(expected, rel=1e-6)
        assert jump > 0


@pytest.mark.parametrize("z", Z)
def test_near_the_edge_it_is_the_form_times_the_jump(z: int) -> None:
    """Less what the white line and the tails of the arctangent put there, the table is left, on either side."""
    width = xraylib.AtomicLevelWidth(z, xraylib.K_SHELL) * 1e3
    away = np.array([-NEAR, -40.0, -20.0, -5.0, 5.0, 20.0, 40.0, NEAR])
    energies = _edge(z) + away * 1e-3
    f = profile((energies - K_EDGES[z].white_line) * 1e3, width, K_EDGES[z])
    jump = _table(z, np.array([_edge(z) + 1e-3]))[0] - _table(z, np.array([_edge(z) - 1e-3]))[0]
    expected = _table(z, energies) + (f - (away > 0)) * jump * (energies / _edge(z)) ** -2.8
    np.testing.assert_allclose(_near(z, energies), expected, atol=1e-3 * jump)


@pytest.mark.parametrize("z", Z)
def test_the_white_line_is_where_it_is_said_and_moves_with_the_charge(z: int) -> None:
    fine = _edge(z) + np.arange(0, 0.05, 2e-6)
    tops = [float(fine[np.argmax(_near(z, fine, charge))]) for charge in (0.0, 0.25, 1.0)]
    assert tops[2] == pytest.approx(K_EDGES[z].white_line, abs=5e-5)  # the arctangent still rises under it
    np.testing.assert_allclose(np.subtract(tops[2], tops[:2]) * 1e3, np.array([1, 0.75]) * K_EDGES[z].shift, atol=5e-3)


def test_the_rise_is_as_wide_as_the_core_hole() -> None:
    """Of an arctangent with full width Γ, half the rise lies within Γ of energy."""
    shape = K_EDGES[28]
    x = np.array([-0.7, 0.7]) - shape.below
    without_line = profile(x, 1.4, shape) - shape.height / (1 + (x / (shape.width / 2)) ** 2)
    np.testing.assert_allclose(without_line, [0.25, 0.75], atol=1e-12)


@given(away=st.floats(-400, 400), charge=st.floats(0, 1))
def test_there_is_no_step_left_and_no_negative_matter(away: float, charge: float) -> None:
    around = _edge(28) + np.array([away, away + 0.01]) * 1e-3
    low, high = _near(28, around, charge)
    assert low > 0 and high > 0
    assert abs(high - low) < 0.01 * 0.7 * 285  # 10 meV: the steepest rise is 1/(π Γ/2) + the line's, of a jump of 285


# Densities as sold or as measured on crystals, in g/cm3, to a few per cent.
DENSITIES = {
    "LiCoO2": 5.05, "NMC111": 4.77, "NMC532": 4.77, "NMC622": 4.77, "NMC811": 4.78, "graphite": 2.26, "Al": 2.70,
    "Cu": 8.96, "Si": 2.33, "Ni": 8.90, "steel": 7.86, "stainless_steel": 8.0, "electrolyte": 1.30,
    "polypropylene": 0.90, "polyethylene": 0.93, "separator": 1.06, "water": 1.0, "air": 1.2e-3, "PVDF": 1.78,
}  # fmt: skip


@pytest.mark.parametrize(("name", "density"), DENSITIES.items(), ids=DENSITIES)
def test_a_known_material_needs_only_its_name(name: str, density: float) -> None:
    material = palette_of("materials", None)(name)
    assert material.name == name
    assert material.density == pytest.approx(density, rel=0.01)
    assert sum(share for _, share in material.fractions) == pytest.approx(1.0, abs=1e-5)
    assert (np.diff(material.attenuation([10.0, 20.0, 40.0])) < 0).all()


def test_the_digits_of_an_nmc_are_its_metals() -> None:
    shares = dict(palette_of("materials", None)("NMC622").fractions)
    moles = np.array([shares[28] / 58.693, shares[25] / 54.938, shares[27] / 58.933])
    np.testing.assert_allclose(moles / moles.sum(), [0.6, 0.2, 0.2], rtol=1e-4)
    assert 25 not in dict(palette_of("materials", None)("NMC901").fractions)
    assert known("NMC000") is None and known("NMC12") is None


def test_the_electrolyte_is_one_molar() -> None:
    """Of one litre, 1300 g, 31 g are phosphorus."""
    shares = dict(palette_of("materials", None)("electrolyte").fractions)
    assert shares[15] == pytest.approx(30.97 / 1300, rel=1e-3)


def test_a_scene_changes_and_adds_materials() -> None:
    colours = palette_of(
        "materials",
        {"NMC811": {"state_of_charge": 0.5, "edge_shift_ev": 3.0}, "coating": {"formula": "Al2O3", "density": 3.95},
         "Al": {"density": 1.35}},
    )  # fmt: skip
    assert (colours("NMC811").state_of_charge, colours("NMC811").edge_shift_ev) == (0.5, 3.0)
    assert colours("NMC622").state_of_charge is None
    assert colours("Al").attenuation(20.0) == pytest.approx(0.1 * 1.35 * 3.442, rel=1e-3)  # NIST
    shares = dict(colours("coating").fractions)
    assert shares[13] == pytest.approx(2 * 26.98 / 101.96, rel=1e-3)
    np.testing.assert_array_equal(colours.filters("Al")(20.0), colours("Al").attenuation(20.0))


test_calls_that_are_refused = refused_calls(__file__, globals())
