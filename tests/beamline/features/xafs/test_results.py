"""Results of an energy scan, and the tabulated edges near it."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamline.core.errors import DataError
from beamline.features.xafs.contrast import AbsorptionEdge, XafsCurve
from beamline.features.xafs.results import (
    XafsResult,
    edge_sentence,
    lines,
    nearest_edges,
    refuse_existing_results,
    table,
    write_results,
)
from recon.prep.matter import edges_of

pytestmark = pytest.mark.usefixtures("real_pictures")

ENERGIES = np.linspace(8.30, 8.40, 11)
ABSORPTION = np.linspace(1.0, 2.0, 11)
SEEN = AbsorptionEdge(True, "", 8.3437, 8.3485, 0.2, 0.01)
FOUND = XafsResult("NMC811", XafsCurve(ENERGIES, ABSORPTION, 0.1 * ABSORPTION, np.full(11, 0.01), "1/mm"), SEEN)


def test_people_are_told_edge_line_and_best() -> None:
    assert lines(FOUND) == [
        "NMC811: 11 energies, 8.3000 to 8.4000 keV",
        "edge        8.3437 keV, where the absorption rises most steeply",
        "white line  8.3485 keV, the top of the absorption",
        "in tables   Ni K 8.3328 keV, 10.9 eV below; Er L3 8.3579 keV, 14.2 eV above",
        "best        8.4000 keV: highest contrast-to-noise of 20 a pixel at this thickness "
        "(95 % of it from 8.3900 to 8.4000 keV)",
    ]
    bare = replace(FOUND, edge=replace(SEEN, white_line=None), curve=XafsCurve(ENERGIES, ABSORPTION))
    assert lines(bare)[2:] == [
        "white line  none above the edge within the range",
        "in tables   Ni K 8.3328 keV, 10.9 eV below; Er L3 8.3579 keV, 14.2 eV above",
        "best        8.4000 keV: highest absorption (95 % of it from 8.3900 to 8.4000 keV)",
    ]
    none = replace(FOUND, edge=AbsorptionEdge(False, "it is smooth", None, None, 0.0, 0.0))
    assert lines(none)[1] == "no edge     it is smooth"
    lacking = replace(none, material="LiCoO2", elements=(3, 8, 27))
    assert "LiCoO2 has no edge from 8.3000 to 8.4000 keV: its nearest is Co K" in lines(lacking)[2]
    assert lacking.data()["tabulated"] in lines(lacking)[2]
    dark = replace(FOUND, curve=replace(FOUND.curve, left_out=np.array([8.41, 8.42])))
    assert lines(dark)[1] == (
        "left out    2 energies between 8.4100 and 8.4200 keV: too dark, too bright for the sensor, or without values"
    )
    assert dark.data()["n_left_out"] == 2 and FOUND.data()["n_left_out"] == 0


def test_programs_are_told_the_same() -> None:
    data = FOUND.data()
    assert (data["edge_seen"], data["edge_kev"], data["white_line_kev"], data["best_kev"]) == (
        True,
        8.3437,
        8.3485,
        8.4,
    )
    assert (data["best_by"], data["contrast_to_noise"], data["why_not"]) == (
        "contrast-to-noise",
        pytest.approx(20),
        None,
    )


def test_the_table_has_a_row_an_energy() -> None:
    rows = list(csv.DictReader(table(FOUND.curve).splitlines()))
    assert len(rows) == 11
    assert list(rows[0]) == ["energy_kev", "absorption (1/mm)", "contrast", "noise", "contrast_to_noise"]
    np.testing.assert_allclose([float(row["energy_kev"]) for row in rows], ENERGIES)
    np.testing.assert_allclose([float(row["contrast_to_noise"]) for row in rows], 10 * ABSORPTION, rtol=1e-6)
    assert table(XafsCurve(ENERGIES, ABSORPTION)).splitlines()[0] == "energy_kev,absorption (line integral)"


def test_picture_and_table_are_written_and_never_overwritten(tmp_path: Path) -> None:
    target = tmp_path / "it.png"
    refuse_existing_results(target)
    write_results([FOUND], target)
    assert target.read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "it.csv").read_text(encoding="utf-8") == table(FOUND.curve)
    assert {path.name for path in tmp_path.iterdir()} == {"it.png", "it.csv"}
    target.unlink()
    with pytest.raises(DataError, match=r"it.csv"):
        write_results([FOUND], target)
    assert {path.name for path in tmp_path.iterdir()} == {"it.csv"}  # nor half of it
    with pytest.raises(DataError, match=r"are never overwritten"):
        refuse_existing_results(target)


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
