"""Delta and beta of materials against xraylib's own refractive indices."""

from __future__ import annotations

import numpy as np
import pytest
import xraylib

from beamline.simulate.matter import delta_beta, in_beam


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


def test_a_filter_needs_a_density() -> None:
    with pytest.raises(ValueError, match=r"the filter 'Sn' has no known density; expected one of LiCoO2, .*Al, Cu"):
        in_beam("Fe2O3", "60kV,Sn=0.5")
    harder, softer = (
        np.average(seen, weights=light) for seen, light in map(in_beam, ("Al", "Al"), ("60kV,Cu=1", "60kV"))
    )
    assert harder < softer
