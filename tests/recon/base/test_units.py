"""Degrees instead of radians, and counts instead of line integrals, are detected; unusual correct data are not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.base.units import (
    look_like_counts,
    look_like_degrees,
    look_like_transmission,
)

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


@pytest.mark.parametrize("step", np.radians([3.0, 18.0, 63.0]))
def test_no_part_of_many_turns_in_radians_looks_like_degrees(step: float) -> None:
    angles = np.arange(0, 700, step)
    assert not any(look_like_degrees(angles[:n], ended=False) for n in range(1, angles.size, 7))
    assert any(look_like_degrees(np.arange(0, 180, 0.25)[:n], ended=False) for n in range(5, 400))


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


def _disc(radius: float, centre: float, depth: float, views: int = 24, cols: int = 96) -> np.ndarray:
    """Line integrals [view, row, col] of a disc that goes round; lengths in half fields."""
    places = centre * np.cos(np.linspace(0, np.pi, views))[:, None, None]
    u = np.linspace(-1, 1, cols)[None, None] - places
    return np.repeat(depth * np.sqrt(np.clip(1 - (u / radius) ** 2, 0, None)), 8, axis=1).astype(np.float32)


@settings(deadline=None)
@given(radius=st.floats(0.3, 0.8), depth=st.floats(0.05, 6), beam=st.floats(0.9, 1.1), noise=st.sampled_from([0, 3e-3]))
def test_transmission_is_told_from_line_integrals(radius: float, depth: float, beam: float, noise: float) -> None:
    lines = _disc(radius, 0.1, depth)
    jitter = noise * np.random.default_rng(0).standard_normal(lines.shape)
    assert look_like_transmission(beam * np.exp(-lines) + jitter)
    assert not look_like_transmission(lines + jitter)
    assert not look_like_transmission(lines + jitter + 1)  # matter all around, and more in the middle


@settings(deadline=None)
@given(
    inner=st.floats(1.0, 5), wall=st.floats(1.02, 3), level=st.floats(0.8, 1.2), noise=st.sampled_from([0, 0.01, 0.1])
)
def test_a_tube_seen_from_within_is_no_transmission(inner: float, wall: float, level: float, noise: float) -> None:
    u, outer = np.linspace(-1, 1, 200), inner * wall
    profile = np.sqrt(outer**2 - u**2) - np.sqrt(np.clip(inner**2 - u**2, 0, None))
    lines = np.broadcast_to(level * profile / profile[0], (24, 8, 200))
    lines = lines + noise * np.random.default_rng(0).standard_normal(lines.shape)
    assert not look_like_transmission(lines)


def test_noise_even_views_and_views_without_pixels_are_no_transmission(rng: np.random.Generator) -> None:
    for values in (rng.normal(0, 1, (9, 8, 64)), rng.normal(1, 0.1, (9, 8, 64)), np.ones((9, 8, 64))):
        assert not look_like_transmission(values)
    assert not look_like_transmission(np.full((9, 8, 64), np.nan))
    assert not look_like_transmission(np.ones((1, 0, 64)))


def test_a_sample_may_reach_one_edge_and_pixels_may_be_unknown() -> None:
    light = np.exp(-_disc(0.6, 0.45, 1.0))
    light[::5, :, 40:44] = np.nan
    light[..., 0] = np.nan
    assert look_like_transmission(light)
