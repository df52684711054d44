"""Intervals: of sizes, from the number of particles; of all slices, from the measured slices; of a change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from splatline_structure.intervals import (
    SPLIT_OR_MERGED,
    Interval,
    MeasuredStructure,
    _of_particles,
    difference,
    measured_structure,
    with_all_slices,
)
from splatline_structure.numbers import Rules, shares_of
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
    assert Interval(1, 0.999, 1, 0, views=0, levels=0, voxels=0, particles=0).words == (
        "no source of error changes the number, so the interval has the smallest width that the command gives "
        "(0.1 % to each side)"
    )
    assert (
        Interval(1, 0.99, 1, 0, views=0, levels=0.01, voxels=0).words
        == "the threshold sets the width of the interval; more projections would not help"
    )


@pytest.fixture(scope="module")
def found() -> MeasuredStructure:
    """A plane of half of the voxels."""
    volume = np.random.default_rng(0).normal(0, 0.02, (12, 20, 20)).astype(np.float32)
    volume[:, 10:] += 1
    return measured_structure(volume, [], 2, (1, 1, 1), Rules(2, 1, side=0))


def slabs(share: float) -> list[np.ndarray]:
    """Two unequal ones of 100 rows, of which this share is of the second material; one slice is in both."""
    slab = np.zeros((3, 100, 20), np.float32)
    slab[:, round(100 * (1 - share)) :] = 1
    return [slab, slab[:2]]


@pytest.mark.parametrize(
    ("share", "low", "high", "why_not"),
    [
        (0.5, 0.42, 0.58, ""),
        (0.98, 0.9, 1.0, ""),  # its own end, where the middle's interval is 0.16 wide
        (0.04, 0.0, 0.12, "the interval is 0 to 0.12, wider than half of the value"),
    ],
)
def test_all_slices_have_the_half_width_of_the_middle_and_ends_of_their_own(
    found: MeasuredStructure, share: float, low: float, high: float, why_not: str
) -> None:
    middle = Interval(0.1, 0.02, 0.18, views=0.0, levels=0.08, voxels=0.0, particles=0.0, why_not="0.02 to 0.18")
    intervals = {**found.intervals, "fraction_2": middle}
    of_all = with_all_slices(replace(found, intervals=intervals), slabs(share)).intervals["fraction_2_all"]
    assert (of_all.value, of_all.low, of_all.high) == pytest.approx((share, low, high))
    assert of_all.why_not == why_not


def test_what_determines_nothing_of_the_middle_determines_nothing_of_all_slices(found: MeasuredStructure) -> None:
    intervals = {name: Interval(0.5, why_not="no contrast") for name in found.intervals}
    of_all = with_all_slices(replace(found, intervals=intervals), slabs(0.5)).intervals["fraction_2_all"]
    assert of_all.why_not == "no contrast" and of_all.value == pytest.approx(0.5)


def layers() -> np.ndarray:
    """Parallel to the slices, 8 of them thick."""
    return np.broadcast_to(np.arange(96)[:, None, None] // 8 % 2, (96, 20, 20)).astype(np.float32)


def blobs() -> np.ndarray:
    return (ndimage.gaussian_filter(np.random.default_rng(1).normal(size=(60, 40, 40)), 2) > 0).astype(np.float32)


@pytest.mark.parametrize(("volume", "off"), [(layers(), 1e-12), (blobs(), 2e-3)])
@pytest.mark.parametrize("n", [2, 5, 12])
def test_fractions_and_surface_of_all_slices_are_those_of_the_whole(
    found: MeasuredStructure, volume: np.ndarray, off: float, n: int
) -> None:
    """Also where all surface lies between two slabs. Crossings within their common slices count in both of them."""
    whole = shares_of(volume.astype(np.uint8), 2, found.spacing, found.rules)
    parts = [volume[max(at[0] - 1, 0) : at[-1] + 1] for at in np.array_split(np.arange(len(volume)), n)]
    of_all = with_all_slices(found, parts)
    for name in ("fraction_1", "fraction_2"):
        assert of_all.intervals[f"{name}_all"].value == pytest.approx(whole[name])
    assert of_all.intervals["surface_all"].value == pytest.approx(whole["surface"], rel=off)
    assert of_all.along_all == pytest.approx(volume.mean(axis=(1, 2)))


def test_a_change_has_the_causes_of_both_states() -> None:
    one = Interval(1, 0.96, 1.06, moves=0.01, views=0.04, levels=0.03, voxels=0, particles=0)
    other = Interval(2, 1.97, 2.09, moves=0.03, views=0.03, levels=0.04, voxels=0.04, particles=0)
    change = difference(one, other)
    assert change.moves == pytest.approx(0.02)
    assert (change.views, change.levels, change.voxels) == pytest.approx((0.05, 0.05, 0.04))
    assert change.words == "more projections would narrow the interval"
