"""Flat structure: Gaussians of stated depth and size that stay where they are on the sensor."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simulators.effects.detector.flat_structure import FlatStructure
from simulators.frame import sensor
from simulators.frame.detector import Detector
from simulators.frame.shot import Shot, fixed_rng
from tests.simulators import shots

CONVERSION = sensor.CONVERSION["standard"]
MANY = FlatStructure(
    specks=1000, radius_um=30.0, scratches=800, scratch_length_um=3000.0, scratch_width_um=12.0, seed=5
)


def _roi(row0: int, col0: int, rows: int, cols: int, binning: int = 1) -> Shot:
    shape = (rows // binning, cols // binning)
    detector = Detector.centred(shape, 0.01 * binning)
    return shots.shot(detector=detector, roi=(row0, col0, rows, cols), binning=binning)


@settings(max_examples=6)
@given(row=st.integers(0, 60), col=st.integers(0, 60), binning=st.sampled_from([1, 2, 4]))
def test_it_stays_on_the_sensor_in_any_roi_and_binning(row: int, col: int, binning: int) -> None:
    whole = MANY.transmission(_roi(200, 300, 320, 320))
    seen = MANY.transmission(_roi(200 + 4 * row, 300 + 4 * col, 80, 64, binning))
    part = whole[4 * row : 4 * row + 80, 4 * col : 4 * col + 64]
    expected = part.reshape(80 // binning, binning, 64 // binning, binning).mean(axis=(1, 3))
    np.testing.assert_allclose(seen, expected, rtol=1e-12)
    assert whole.std() > 0.01


def test_specks_take_the_light_of_their_gaussians() -> None:
    """Mean loss of many: their number x mean depth x 2 pi E r² over the sensor's area. Radii are even in 1/2 ... 3/2 of
    10 pixels: E r² = 100 x 13/12, and E (depth r²)² gives the spread; wrong once in a million seeds."""
    specks = FlatStructure(specks=4000, radius_um=100.0, depth=0.01, scratches=0, seed=2)
    loss = 1 - specks.transmission(_roi(0, 0, 2304, 4096))
    area = 2304 * 4096
    mean = 4000 * 0.01 * 2 * math.pi * 100 * (13 / 12) / area
    # E depth² = 4/3 of the mean's square; E r^4 of the same law = (1.5^5 - 0.5^5) / 5 = 1.5125.
    each = 2 * math.pi * 100 * 0.01 * math.sqrt(4 / 3 * 1.5125)
    overlaps, edge = 0.01 * mean * 10, 0.01 * mean
    assert loss.mean() == pytest.approx(mean, abs=4.9 * each * math.sqrt(4000) / area + overlaps + edge)
    assert 0.005 < loss.max() < 0.06
    assert loss.min() == 0.0


def test_a_speck_is_round_and_a_gaussian() -> None:
    rng = fixed_rng("flat_structure", 11)
    row, col, size, deep = rng.random(4) * (2304, 4096, 6.0, 0.4) + (0, 0, 3.0, 0)
    row0, col0 = 4 * (int(row) // 4 - 15), 4 * (int(col) // 4 - 15)
    seen = FlatStructure(1, 60.0, 0.2, scratches=0, seed=11).transmission(_roi(row0, col0, 120, 120))
    j, i = np.mgrid[:120, :120]
    expected = 1 - deep * np.exp(-((j + row0 - row) ** 2 + (i + col0 - col) ** 2) / (2 * size**2))
    np.testing.assert_allclose(seen, expected, atol=deep * math.exp(-8))


def test_scratches_take_the_light_of_lines() -> None:
    """A scratch of length L takes depth x (L sqrt(2 pi) w + 2 pi w²), whatever its angle, away from edges."""
    inside = 0
    for seed in range(8):
        scratch = FlatStructure(0, scratches=1, scratch_length_um=800.0, scratch_width_um=20.0, seed=seed)
        rng = fixed_rng("flat_structure", seed)
        row, col, angle, chance, deep = rng.random(5) * (2304, 4096, math.pi, 1, 0.1)
        length = -math.log1p(-chance) * 80
        reach = length / 2 + 10
        if not (reach < row < 2304 - reach and reach < col < 4096 - reach):
            continue
        inside += 1
        loss = 1 - scratch.transmission(_roi(0, 0, 2304, 4096))
        assert loss.sum() == pytest.approx(deep * (length * math.sqrt(2 * math.pi) * 2 + 8 * math.pi), rel=2e-3)
        j, i = np.nonzero(loss > 0.5 * loss.max())
        if length > 40:  # its direction is its angle: rows along its sine, columns along its cosine
            moments = np.cov(j, i)
            assert math.atan2(2 * moments[0, 1], moments[1, 1] - moments[0, 0]) / 2 % math.pi == pytest.approx(
                angle % math.pi, abs=0.05
            )
    assert inside >= 4


@pytest.mark.parametrize("width_um", [1e3, 1e6, 1e9])
def test_a_scratch_wider_than_the_frame_costs_no_more_than_the_frame(width_um: float) -> None:
    """Across and at its ends it is a Gaussian at every pixel."""
    rng = fixed_rng("flat_structure", 3)
    row, col, angle, chance, deep = rng.random(5) * (2304, 4096, math.pi, 1, 0.1)
    scratch = FlatStructure(0, scratches=1, scratch_length_um=800.0, scratch_width_um=width_um, seed=3)
    seen = scratch.transmission(_roi(1000, 2000, 120, 200))
    dy, dx = np.arange(120)[:, None] + 1000 - row, np.arange(200) + 2000 - col
    along = np.abs(dy * math.sin(angle) + dx * math.cos(angle)) + math.log1p(-chance) * 40
    across = dx * math.sin(angle) - dy * math.cos(angle)
    beside = (np.maximum(along, 0) ** 2 + across**2) / (width_um / 10) ** 2
    near = beside < 16
    np.testing.assert_allclose(seen[near], (1 - deep * np.exp(-beside / 2))[near], atol=1e-12)


def test_a_flat_divides_it_out() -> None:
    effect = {"kind": "flat_structure", "specks": 15_000, "radius_um": 60.0, "scratches": 200, "seed": 3}
    scene = shots.scene(effect)
    flat = shots.frame(scene, sample=False)
    np.testing.assert_allclose(flat * CONVERSION / 4000, FlatStructure(15_000, 60.0, scratches=200, seed=3)
                               .transmission(shots.shot()), atol=2e-5)  # fmt: skip
    assert flat.std() / flat.mean() > 0.02
    np.testing.assert_allclose(shots.frame(scene) / flat, np.exp(-shots.depth(scene, 0.4)), rtol=3e-3)
