"""Which edge an energy belongs to, and what is said of a material without an edge in the range."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamline.features.xafs.results import edge_sentence, nearest_edges
from recon.prep.matter import edges_of

LITHIUM, OXYGEN, MANGANESE, COBALT, NICKEL = 3, 8, 25, 27, 28


def test_licoo2_has_no_edge_at_the_white_line_of_nickel_oxide() -> None:
    said = edge_sentence("LiCoO2", (LITHIUM, OXYGEN, COBALT), 8.30, 8.42, None)
    assert "LiCoO2 has no edge from 8.3000 to 8.4200 keV" in said
    assert "nearest is Co K 7.7089 keV, 591.1 eV below the range" in said
    assert "In the range lies Ni K 8.3328 keV, of an element that it lacks" in said


def test_an_edge_is_named_with_its_distance_and_side() -> None:
    assert edge_sentence("NMC811", (LITHIUM, OXYGEN, MANGANESE, COBALT, NICKEL), 8.30, 8.42, 8.3485) == (
        "Ni K 8.3328 keV, 15.7 eV below"
    )
    measured = edge_sentence("", (), 8.30, 8.42, 8.3485)
    assert "Ni K 8.3328 keV, 15.7 eV below" in measured and "Er L3 8.3579 keV, 9.4 eV above" in measured
    assert edge_sentence("", (), 8.30, 8.42, None) == ""


def test_an_edge_that_noise_hides_is_not_said_to_be_absent() -> None:
    assert (
        edge_sentence("LiCoO2", (LITHIUM, OXYGEN, COBALT), 7.6, 7.8, None) == "LiCoO2 has Co K 7.7089 keV in this range"
    )
    above = edge_sentence("LiCoO2", (LITHIUM, OXYGEN, COBALT), 7.0, 7.5, None)
    assert "nearest is Co K 7.7089 keV, 208.9 eV above the range" in above


@given(energy=st.floats(1.0, 100.0), elements=st.lists(st.integers(11, 92), min_size=1, max_size=5, unique=True))
def test_no_edge_of_the_material_is_nearer(energy: float, elements: list[int]) -> None:
    (nearest,) = nearest_edges(energy, elements)
    others = edges_of(elements)
    assert nearest in others
    assert abs(nearest.energy - energy) == pytest.approx(min(abs(each.energy - energy) for each in others))
