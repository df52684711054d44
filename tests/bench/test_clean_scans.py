"""Scans without a fault get no word of the rules, of any kind of beam, light and sample; and those that change do."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.bench.clean_scans import COUNT, clean_scan, unexplained


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, COUNT, 30))
def test_clean_scans_get_no_word(first: int) -> None:
    words = {seed: unexplained(*clean_scan(seed)) for seed in range(first, first + 30)}
    assert {seed: said for seed, said in words.items() if said} == {}


@pytest.mark.parametrize("beam", ["half", "cone"])
def test_a_sample_that_shrinks_in_one_mass_is_told_of_with_volumes_in_time(beam: str) -> None:
    def shrinks(t: float, balls: NDArray[np.float64]) -> NDArray[np.float64]:
        size = 1 - 0.07 * t
        return np.asarray(balls * [size, size, size, size, size**-3])

    kind = {"views": 90, "rows": 20, "cols": 64, "wide": False, "depth": 1.5, "light": 2e4, "exposed": False}
    scan, why = clean_scan(0, shrinks, beam=beam, order="even", written="counts", harden=0.02, count=10, **kind)
    (sentence,) = unexplained(scan, why)
    assert "% narrower" in sentence
    assert "--time N" in sentence
