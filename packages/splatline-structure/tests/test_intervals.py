"""Intervals of sizes, by the particles that are there."""

from __future__ import annotations

import numpy as np
import pytest

from splatline_structure.intervals import SPLIT_OR_MERGED, Interval, _of_particles
from splatline_structure.particles import Particles


def grains(n: int, cut: bool = False) -> Particles:
    """Particles of 8 to 16 µm, as many of a diameter d as 1/d³, so that each micrometre has as much of the volume."""
    u = (np.arange(n) + 0.5) / n
    diameter = (8.0**-2 - u * (8.0**-2 - 16.0**-2)) ** -0.5
    return Particles(
        np.arange(1, n + 1, dtype=np.int32), np.pi / 6 * diameter**3, diameter**2, np.zeros((n, 3)), np.full(n, cut),
        ((),) * n,
    )  # fmt: skip


@pytest.mark.parametrize("percent", [10, 50, 90])
def test_a_size_is_as_sure_as_a_share_of_so_many_particles(percent: int) -> None:
    """A share s of n has the deviation √(s (1 - s) / n), and each share of the volume here is 8 µm wide."""
    share = percent / 100
    off = SPLIT_OR_MERGED * np.sqrt(share * (1 - share) / 400)
    assert _of_particles(f"size_{percent}", grains(400)) == pytest.approx(8 * off, rel=0.05)


def test_other_numbers_and_a_field_without_whole_particles_have_none_of_it() -> None:
    assert _of_particles("surface", grains(5)) == _of_particles("size_50", grains(5, cut=True)) == 0


def test_words_name_no_cause_where_none_moves_a_number() -> None:
    assert Interval(1, 0.999, 1, 0, views=0, levels=0, voxels=0, particles=0).words == "nothing moves this"
    assert Interval(1, 0.99, 1, 0, views=0, levels=0.01, voxels=0).words == "the threshold decides this, not the views"
