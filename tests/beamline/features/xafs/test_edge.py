"""Edge: found where a known curve has it, within a fraction of a step, and not found where there is none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from beamline.features.xafs.contrast import LEAST, _step, find_edge

Reals = NDArray[np.float64]


def _curve(energies: Reals, edge: float, line: float = 0.6, jump: float = 2.0) -> Reals:
    """A smooth fall, a rise of 1.4 eV at `edge`, and a white line 5 eV wide 6 eV above it."""
    away = (energies - edge) * 1e3
    step = 0.5 + np.arctan(away / 0.7) / np.pi
    return (energies / edge) ** -2.8 * (0.8 + jump * (step + line / (1 + ((away - 6) / 2.5) ** 2)))


def _smooth(energies: Reals) -> Reals:
    return 3.0 * (energies / 8.0) ** -2.85 + 0.02


@settings(max_examples=40, deadline=None)
@given(
    edge=st.floats(8.33, 8.36), step=st.sampled_from([0.0005, 0.001, 0.0015]), noise=st.sampled_from([0.0, 0.002]),
    seed=st.integers(0, 99),
)  # fmt: skip
def test_edge_and_white_line_are_found_within_half_a_step_and_a_bit(
    edge: float, step: float, noise: float, seed: int
) -> None:
    energies = np.arange(8.30, 8.40, step)
    curve = _curve(energies, edge) + np.random.default_rng(seed).normal(0, noise, energies.size)
    found = find_edge(energies, curve)
    assert found.found and found.reason == ""
    assert found.energy == pytest.approx(edge, abs=max(step, 0.0006))
    assert found.white_line == pytest.approx(edge + 0.006, abs=max(step / 2, 0.0005))


@pytest.mark.parametrize("offset", [-0.4, -0.2, 0.0, 0.3, 0.5])
def test_the_white_line_is_found_between_two_energies(offset: float) -> None:
    energies = 8.30 + 0.001 * (np.arange(100) + offset)
    found = find_edge(energies, _curve(energies, 8.343, line=1.0))
    assert found.white_line == pytest.approx(8.349, abs=0.0002)


def test_the_spacing_may_be_uneven() -> None:
    energies = np.concatenate(
        [np.arange(8.30, 8.335, 0.004), np.arange(8.335, 8.36, 0.0007), np.arange(8.36, 8.42, 0.005)]
    )
    found = find_edge(energies, _curve(energies, 8.3437))
    assert found.energy == pytest.approx(8.3437, abs=0.0005)
    assert found.white_line == pytest.approx(8.3497, abs=0.0005)


def test_an_edge_without_a_white_line_has_none() -> None:
    energies = np.arange(8.30, 8.40, 0.001)
    found = find_edge(energies, _curve(energies, 8.343, line=0.0))
    assert found.found and found.energy == pytest.approx(8.343, abs=0.0005)
    assert found.white_line is None


@settings(max_examples=60, deadline=None)
@given(
    low=st.floats(5, 20), width=st.floats(0.02, 3.0), noise=st.sampled_from([0.0, 1e-4, 0.01, 0.3]),
    seed=st.integers(0, 10**6),
)  # fmt: skip
def test_a_curve_without_an_edge_has_none(low: float, width: float, noise: float, seed: int) -> None:
    """Whatever the noise: a false alarm in a million curves."""
    energies = np.linspace(low, low + width, 121)
    found = find_edge(energies, _smooth(energies) + np.random.default_rng(seed).normal(0, noise, 121))
    assert not found.found
    assert (found.energy, found.white_line) == (None, None)
    assert "as smooth as one without an edge" in found.reason


def test_an_edge_at_the_end_of_the_range_is_told_apart() -> None:
    for energies in (np.arange(8.30, 8.344, 0.001), np.arange(8.3437, 8.40, 0.001)):
        found = find_edge(energies, _curve(energies, 8.3437))
        assert not found.found and "steepest at the end of the range; widen the range" in found.reason


@pytest.mark.parametrize("line", [0.0, 0.6])
def test_an_edge_of_six_times_the_noise_is_seen(line: float) -> None:
    """To a person it is plain; it is within 4 eV, which is as much as five energies' noise leaves open."""
    energies = np.arange(8.30, 8.42, 0.001)
    for seed in range(20):
        noise = np.random.default_rng(seed).normal(0, 1 / 6, energies.size)
        found = find_edge(energies, _curve(energies, 8.3437, line, jump=1.0) + noise)
        assert found.found and found.energy == pytest.approx(8.3437, abs=0.004)


@pytest.mark.parametrize("n", [LEAST, 40])
def test_the_chance_of_a_false_alarm_is_what_it_says(n: int) -> None:
    """A chance below p comes in at most p of 3000 curves of noise: 1e-6 of all such tests have more than these."""
    basis = np.linalg.qr(np.linspace(1, 1.1, n)[:, None] ** np.array([0, -3, -4]))[0]
    noise = np.random.default_rng(n).normal(size=(3000, n))
    chances = np.array([_step(one - basis @ (basis.T @ one), basis)[1] for one in noise])
    for p, most in ((0.1, 380), (0.01, 58), (0.001, 15)):
        assert (chances < p).sum() <= most
    assert (chances < 0.1).sum() > 60  # and not because it never rings


def test_the_top_of_a_bare_step_is_no_white_line_however_far_the_curve_falls_beyond() -> None:
    for last in (8.42, 8.7, 9.2):
        energies = np.arange(8.30, last, 0.002)
        assert find_edge(energies, _curve(energies, 8.3437, line=0.0)).white_line is None
        found = find_edge(energies, _curve(energies, 8.3437))
        assert found.white_line == pytest.approx(8.3497, abs=0.001)
    energies = np.arange(8.30, 8.42, 0.001)
    for seed in range(20):
        noise = np.random.default_rng(seed).normal(0, 0.02, energies.size)
        assert find_edge(energies, _curve(energies, 8.3437, line=0.0) + noise).white_line is None


def test_what_only_falls_has_no_edge() -> None:
    energies = np.arange(8.30, 8.40, 0.001)
    fall = -np.arctan((energies - 8.35) * 1e3 / 2) - 20 * (energies - 8.3)
    found = find_edge(energies, fall)
    assert not found.found and found.reason == "the absorption rises nowhere"


def test_the_noise_is_that_of_the_curve() -> None:
    energies = np.linspace(8.3, 8.4, 4001)
    curve = _curve(energies, 8.34) + np.random.default_rng(5).normal(0, 0.01, 4001)
    assert find_edge(energies, curve).noise == pytest.approx(0.01, rel=0.1)


@pytest.mark.parametrize("energies", [np.linspace(8, 9, LEAST - 1), np.array([*np.linspace(8, 9, LEAST), 9.0])])
def test_too_few_energies_or_unsorted_ones_are_refused(energies: Reals) -> None:
    with pytest.raises(ValueError, match=f"{LEAST} rising"):
        find_edge(energies, np.ones_like(energies))
