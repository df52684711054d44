"""Radiographs: Beer-Lambert for any unit of counts, and no number where there was no light to tell one."""

from __future__ import annotations

import numpy as np
import pytest

from beamline.features.xafs.series import line_integrals

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
