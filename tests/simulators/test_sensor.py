"""Sensor: the converter's range and the ORCA-Quest's figures."""

from __future__ import annotations

import numpy as np
import pytest

from simulators.sensor import CONVERSION, OFFSET, READ_NOISE, digitise


def test_counts_are_rounded_and_clipped_to_sixteen_bits() -> None:
    counts = digitise(np.array([-3.0, 0.4, 0.6, 199.5, 200.5, 65534.6, 1e9]))
    assert counts.dtype == np.uint16
    np.testing.assert_array_equal(counts, [0, 0, 1, 200, 200, 65535, 65535])


def test_the_converter_ends_just_below_the_full_well() -> None:
    electrons = (65535 - OFFSET) * CONVERSION["standard"]
    assert 6990 < electrons < 7000
    # Dynamic range as the data sheet states it: full well over read noise.
    assert 7000 / READ_NOISE["ultra_quiet"] == pytest.approx(25_900, rel=2e-3)
    assert 7000 / READ_NOISE["standard"] == pytest.approx(16_300, rel=2e-3)
