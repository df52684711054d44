"""Edge: the table's jump, a rise and a line where the form puts them, and the table itself beyond."""

from __future__ import annotations

import numpy as np
import pytest
import xraylib
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from simulators.samples.materials.materials import FAR, K_EDGES, NEAR, near_edge, profile

Reals = NDArray[np.float64]
Z = sorted(K_EDGES)


def _table(z: int, energies: Reals) -> Reals:
    return np.array([xraylib.CS_Total(z, float(e)) for e in energies])


def _edge(z: int) -> float:
    return float(xraylib.EdgeEnergy(z, xraylib.K_SHELL))


def _near(z: int, energies: Reals, charge: float = 1.0) -> Reals:
    width = xraylib.AtomicLevelWidth(z, xraylib.K_SHELL) * 1e3
    return near_edge(energies, lambda e: _table(z, e), _edge(z), width, K_EDGES[z], charge)


@pytest.mark.parametrize(("z", "kev"), [(25, 6.539), (27, 7.709), (28, 8.333)])
def test_edges_are_where_the_tables_have_them(z: int, kev: float) -> None:
    """Bearden & Burr, Rev. Mod. Phys. 39, 125, 1967: Mn 6539.0, Co 7708.9, Ni 8332.8 eV."""
    assert _edge(z) == pytest.approx(kev, abs=2.5e-4)


@pytest.mark.parametrize(("z", "ev"), [(25, 1.11), (27, 1.28), (28, 1.39)])
def test_core_holes_are_as_wide_as_the_source_has_them(z: int, ev: float) -> None:
    """Campbell & Papp 2001; Krause & Oliver 1979 have 0.05 eV more, which nothing here would show."""
    assert xraylib.AtomicLevelWidth(z, xraylib.K_SHELL) * 1e3 == pytest.approx(ev, abs=0.005)


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


@pytest.mark.parametrize("z", Z)
def test_the_table_takes_over_without_a_step(z: int) -> None:
    """The tails of the form, a thousandth of the jump at 150 eV, are gone by there."""
    for away in (-FAR, FAR):
        low, high = _near(z, _edge(z) + np.array([away - 0.01, away + 0.01]) * 1e-3)
        assert abs(high - low) < 2e-5 * 400  # 0.02 eV of the table's own fall


@given(away=st.floats(-400, 400), charge=st.floats(0, 1))
def test_there_is_no_step_left_and_no_negative_matter(away: float, charge: float) -> None:
    around = _edge(28) + np.array([away, away + 0.01]) * 1e-3
    low, high = _near(28, around, charge)
    assert low > 0 and high > 0
    assert abs(high - low) < 0.01 * 0.7 * 285  # 10 meV: the steepest rise is 1/(π Γ/2) + the line's, of a jump of 285
