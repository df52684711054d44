"""Sensor: the converter's range and the ORCA-Quest's figures."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.orca_quest import LINE_TIME
from simulators.frame.sensor import (
    CONVERSION,
    FULL_WELL,
    LARGEST_PHOTON_NUMBER,
    OFFSET,
    READ_NOISE,
    digitise,
    largest_count,
)


def test_counts_are_rounded_and_clipped_to_sixteen_bits() -> None:
    counts = digitise(np.array([-3.0, 0.4, 0.6, 199.5, 200.5, 65534.6, 1e9]))
    assert counts.dtype == np.uint16
    np.testing.assert_array_equal(counts, [0, 0, 1, 200, 200, 65535, 65535])


def test_the_converter_ends_just_below_the_full_well() -> None:
    electrons = (65535 - OFFSET["standard"]) * CONVERSION["standard"]
    assert 6990 < electrons < FULL_WELL
    # Dynamic range as the data sheet states it: full well over read noise.
    assert FULL_WELL / READ_NOISE["ultra_quiet"] == pytest.approx(25_900, rel=2e-3)
    assert FULL_WELL / READ_NOISE["standard"] == pytest.approx(16_300, rel=2e-3)


def test_each_readout_has_its_figures_and_ends() -> None:
    assert set(CONVERSION) == set(OFFSET) == set(READ_NOISE) == set(LINE_TIME)
    assert largest_count("standard", 4) == largest_count("ultra_quiet", 1) == 65_535
    assert [largest_count("photon_number", n) for n in (1, 2, 4)] == [LARGEST_PHOTON_NUMBER * n**2 for n in (1, 2, 4)]
    np.testing.assert_array_equal(digitise(np.array([-0.4, 0.6, 199.6, 300.0]), 200), [0, 1, 200, 200])
