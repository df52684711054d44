"""Palette: every material that can be named, what a scene changes, and names that nobody knows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from simulators.frame.mapping import SceneError
from simulators.samples.materials.palette import known, palette_of

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


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ([], r"materials must be a mapping from names to the properties of materials; got \[\]"),
        ({"NMC811": 3}, "materials.NMC811 must be a mapping"),
        ({"NMC811": {"charge": 1}}, "materials.NMC811: key 'charge' is unknown; legal: formula, density, state_of"),
        ({"NMC811": {"state_of_charge": 2}}, "materials.NMC811: NMC811: state_of_charge must lie in 0 ... 1, got 2.0"),
        ({"Al": {"state_of_charge": 1}}, "this has none of them"),
        ({"glue": {"density": 1.1}}, "materials.glue: 'glue' is not a known material; give formula and density"),
        ({"glue": {"formula": "C2H4"}}, "materials.glue: 'glue' is not a known material; give formula and density"),
        ({"glue": {"formula": "Qq", "density": 1}}, "materials.glue: Invalid chemical formula"),
        ({"glue": {"formula": "C", "density": -1}}, "density must lie between 0 and 100"),
    ],
)
def test_an_impossible_material_is_refused(entry: Any, words: str) -> None:
    with pytest.raises(SceneError, match=words):
        palette_of("materials", entry)


def test_an_unknown_name_is_told_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"'mud'.*NMC"):
        palette_of("materials", {"glue": {"formula": "C2H4", "density": 1.1}})("mud")
