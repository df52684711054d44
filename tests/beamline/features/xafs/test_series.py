"""Radiographs become a curve, energy by energy."""

from __future__ import annotations

import numpy as np
import pytest

from beamline.core.events import Event
from beamline.features.xafs.contrast import ContrastRegions
from beamline.features.xafs.series import Series, line_integrals, run_series
from drivers.base.clock import SystemClock

REGIONS = ContrastRegions(np.ones((4, 5), dtype=np.bool_))
FRAMES = [(8.0 + 0.1 * k, np.full((4, 5), float(k))) for k in range(6)]


def test_a_series_becomes_a_curve_and_says_how_far_it_is() -> None:
    events: list[Event] = []
    run = run_series(Series("it", 6, reversed(FRAMES), REGIONS), events.append, SystemClock(), lambda: False)
    assert not run.stopped
    np.testing.assert_allclose(run.curve.energies, 8.0 + 0.1 * np.arange(6))
    np.testing.assert_array_equal(run.curve.absorption, np.arange(6.0))
    assert (events[-1].event, events[-1].data["stage"], events[-1].data["n"], events[-1].data["of"]) == (
        "progress", "xafs", 6, 6,
    )  # fmt: skip


def test_an_early_end_keeps_the_energies_so_far() -> None:
    asked = iter([False, False, True])
    run = run_series(Series("it", 6, iter(FRAMES), REGIONS), lambda event: None, SystemClock(), lambda: next(asked))
    assert run.stopped and run.curve.energies.size == 3


def test_a_stop_at_the_last_energy_cuts_nothing() -> None:
    run = run_series(Series("it", 1, iter(FRAMES[:1]), REGIONS), lambda event: None, SystemClock(), lambda: True)
    assert not run.stopped and run.curve.energies.size == 1


TRUE = np.linspace(0.0, 6.0, 12).reshape(3, 4)


@pytest.mark.parametrize("open_beam", [1.0, 60.0, 5000.0])
def test_line_integrals_are_minus_the_logarithm_in_any_unit(open_beam: float) -> None:
    flat = np.full((3, 4), open_beam)
    np.testing.assert_allclose(line_integrals(flat * np.exp(-TRUE), flat), TRUE, atol=1e-12)


def test_dark_is_infinite_and_what_is_not_known_is_no_number() -> None:
    signal = np.array([0.4, 0.6, -3.0, 0.0, np.nan, 10.0, 10.0, 10.0, 10.0])
    flat = np.array([5e3, 5e3, 5e3, 1.0, 5e3, np.nan, 0.0, -2.0, np.inf])
    found = line_integrals(signal, flat)
    np.testing.assert_array_equal(found[[0, 2, 3]], np.inf)
    assert found[1] == pytest.approx(np.log(5e3 / 0.6))
    assert np.isnan(found[4:]).all()
