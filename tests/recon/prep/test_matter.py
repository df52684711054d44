"""Delta, beta and tube spectra compared with xraylib and with the simulator, which reads the same tables."""

from __future__ import annotations

import numpy as np
import pytest
import xraylib

from recon.features.beam_hardening import curve_of_spectrum
from recon.prep.matter import KNOWN, absorbed_dose, delta_beta, mass_attenuation, tube_spectrum
from simulators.light import Beam, Tube
from simulators.samples.materials.materials import Palette
from simulators.samples.materials.spectrum import light
from tests.refused_calls import refused_calls


@pytest.mark.parametrize(("name", "formula"), [("water", "H2O"), ("SiO2", "SiO2"), ("Al", "Al"), ("LiCoO2", "LiCoO2")])
@pytest.mark.parametrize("energy", [8.0, 25.0])
def test_the_ratio_is_that_of_the_refractive_index(name: str, formula: str, energy: float) -> None:
    delta = 1 - xraylib.Refractive_Index_Re(formula, energy, 1.0)
    beta = xraylib.Refractive_Index_Im(formula, energy, 1.0)
    assert delta_beta(name, energy) == pytest.approx(delta / beta, rel=1e-4)


@pytest.mark.parametrize("name", [*KNOWN, "NMC622"])
def test_corrections_and_simulator_share_tables_compositions_and_densities(name: str) -> None:
    """The one thing that both know: a wrong cross section would be in the data and in the correction."""
    simulated, energies = Palette()(name), np.array([8.0, 25.0, 120.0])
    np.testing.assert_allclose(
        mass_attenuation(name, energies), 10 * simulated.attenuation(energies) / simulated.density, rtol=1e-12
    )
    if not name.startswith("NMC"):  # which no filter is of
        energies, behind = tube_spectrum(800.0, {name: 0.1})
        weights = np.interp(energies, *tube_spectrum(800.0, {})) * np.exp(-0.1 * simulated.attenuation(energies))
        np.testing.assert_allclose(behind, weights, rtol=1e-5, atol=1e-6)  # an open beam has fewer nodes left


@pytest.mark.parametrize(("kv", "filters"), [(160.0, {"Cu": 0.5}), (60.0, {"Al": 1.0})])
def test_a_tube_hardens_as_the_simulated_one_does(kv: float, filters: dict[str, float]) -> None:
    """The simulator finds as few energies as a material needs; here are all of them."""
    palette = Palette()
    steel = palette("steel")
    thickness = np.linspace(0, 4 / float(steel.attenuation(kv / 2)), 9)
    found = light(Beam(0.0, tube=Tube(kv, filters)), [steel.attenuation], thickness[-1], palette.filters)
    views = -np.log(found.transmission(steel.attenuation, thickness)).astype(np.float32)[None]
    energies, weights = tube_spectrum(kv, filters)
    seen = views.copy()
    curve_of_spectrum(mass_attenuation("steel", energies), weights, float(seen.max())).linearise(seen)
    np.testing.assert_allclose(seen[0], found.mean(steel.attenuation) * thickness, rtol=3e-3, atol=1e-4)
    assert views[0, -1] < 0.9 * seen[0, -1]


@pytest.mark.parametrize(("energy", "absorbed"), [(10.0, 4.944), (20.0, 0.5503), (30.0, 0.1557), (60.0, 0.03190)])
def test_a_dose_is_fluence_times_energy_times_absorption(energy: float, absorbed: float) -> None:
    """Coefficients of water in cm²/g: Hubbell & Seltzer, NISTIR 5632 (1995)."""
    expected = 1e6 * 100 * energy * 1.602176634e-16 * absorbed * 1000
    assert absorbed_dose("water", energy, 1e6) == pytest.approx(expected, rel=0.03)


test_calls_that_are_refused = refused_calls(__file__, globals())
