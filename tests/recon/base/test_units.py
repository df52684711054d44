"""Degrees for radians and counts for line integrals are told from what is right, also where that is unusual."""

from __future__ import annotations

import numpy as np
import pytest

from recon.base.units import look_like_counts, look_like_degrees

SCANS = {
    "half a turn": np.arange(0, 180, 0.1),
    "uneven steps": np.linspace(0, 180, 721),
    "a full turn": np.linspace(-180, 180, 1000, endpoint=False),
    "a sector": np.arange(0, 60, 1.0),
}


@pytest.mark.parametrize("name", SCANS)
def test_degrees_are_told_from_radians(name: str) -> None:
    assert look_like_degrees(SCANS[name])
    assert not look_like_degrees(np.deg2rad(SCANS[name]))


def test_radians_of_many_turns_are_no_degrees() -> None:
    assert not look_like_degrees(np.linspace(0, 40 * 2 * np.pi, 7201))
    assert not look_like_degrees(np.deg2rad([0.0, 120.0, 240.0]))
    assert not look_like_degrees(np.array([0.0, 1.0, 2.0, 3.0]))  # too few to tell


def test_counts_are_told_from_line_integrals(rng: np.random.Generator) -> None:
    lines = rng.uniform(0, 6, (5, 8, 16)).astype(np.float32)
    counts = rng.poisson(100 + 2e4 * np.exp(-lines)).astype(np.float32)
    assert look_like_counts(counts)
    assert look_like_counts(counts - 99.5)  # with the dark taken away
    assert not look_like_counts(lines)
    lines[:, :, 4:12] += 30.3  # an opaque body, with air beside it
    lines[0, 0, 0] = np.nan
    assert not look_like_counts(lines)
    assert not look_like_counts(np.full((2, 3, 4), np.nan, np.float32))
