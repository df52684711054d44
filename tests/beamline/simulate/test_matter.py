"""Delta and beta of materials against xraylib's own refractive indices."""

from __future__ import annotations

import pytest
import xraylib

from beamline.simulate.matter import delta_beta


@pytest.mark.parametrize(("name", "formula"), [("water", "H2O"), ("SiO2", "SiO2"), ("Al", "Al"), ("LiCoO2", "LiCoO2")])
@pytest.mark.parametrize("energy", [8.0, 25.0])
def test_the_ratio_is_that_of_the_refractive_index(name: str, formula: str, energy: float) -> None:
    delta = 1 - xraylib.Refractive_Index_Re(formula, energy, 1.0)
    beta = xraylib.Refractive_Index_Im(formula, energy, 1.0)
    assert delta_beta(name, energy) == pytest.approx(delta / beta, rel=1e-4)


def test_what_is_no_material_is_said() -> None:
    with pytest.raises(ValueError, match="'bone' is neither a material that scenes know nor a chemical formula"):
        delta_beta("bone", 20.0)
    with pytest.raises(ValueError, match="tabulated from"):
        delta_beta("Al", 2000.0)
