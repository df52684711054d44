"""The box around the sample contains all of it, is not much larger, and is the whole volume for a wide sample."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.projections.selection import Selection
from beamline.projections.views import select
from beamline.reconstruct.region import box_around_sample
from tests.beamline.array_source import scan_of
from tests.slow_cases import others_slow

ROWS, COLS, AXIS, BEAM, DARK = 24, 96, 50.0, 3000.0, 100
ANGLES = np.radians(np.arange(0, 180, 3.0))
PLAIN = Selection(axis_col=AXIS)


def cylinders(*bodies: tuple[float, float, float, float, slice]) -> NDArray[np.float64]:
    """Line integrals [view, row, col] of upright cylinders: x, y, radius (pixels), attenuation, rows."""
    out = np.zeros((ANGLES.size, ROWS, COLS))
    u = np.arange(COLS) - AXIS
    for x, y, radius, mu, rows in bodies:
        centre = x * np.cos(ANGLES) + y * np.sin(ANGLES)
        half = np.sqrt(np.clip(radius**2 - (u - centre[:, None]) ** 2, 0, None))
        out[:, rows] += 2 * mu * half[:, None]
    return out


def scan(depth: NDArray[np.float64], cone: tuple[float, float] | None = None) -> Any:
    rng = np.random.default_rng(4)
    light = np.zeros((3, ROWS, COLS)), np.full((9, ROWS, COLS), BEAM), BEAM * np.exp(-depth)
    darks, flats, views = (DARK + rng.poisson(each) for each in light)
    source = scan_of(darks, flats, views, ANGLES)
    source.cone = cone
    return source


@pytest.mark.parametrize(("faint", "binning"), others_slow([(0.3, 2), (0.012, 1)]))
def test_the_box_holds_the_sample_and_a_margin(faint: float, binning: int) -> None:
    """A dense body, and one in other rows that absorbs as much or a twentieth of it."""
    bodies = (10.0, -12.0, 8.0, 0.1, slice(6, 15)), (-14.0, 5.0, 6.0, faint, slice(12, 18))
    region = box_around_sample(select(scan(cylinders(*bodies)), replace(PLAIN, binning=binning)))
    middle = (COLS + 2 * abs(AXIS - (COLS - 1) / 2) - 1) / 2  # of the widest volume that the axis may ask for
    for low, high, span in ((6, 18, region.z), (-20, 11, region.y), (-20, 18, region.x)):
        offset = 0 if span is region.z else middle
        first, end = (edge * binning for edge in span)
        assert first <= low + offset and end >= high + offset
        assert end - first < 1.5 * (high - low) + 10
    assert "with a margin" in region.reason and f"{region} [z, y, x]" in region.reason


@pytest.mark.slow
@pytest.mark.parametrize("rows", [slice(8, 16), slice(0, ROWS)])
def test_of_a_sample_beyond_the_field_all_is_made(rows: slice) -> None:
    region = box_around_sample(select(scan(cylinders((0, 0, 70.0, 0.01, rows))), PLAIN))
    assert region.z == (0, ROWS) and region.y == region.x and region.x[0] == 0 and region.x[1] >= COLS
    assert "the sample extends beyond the field of view at the left and the right" in region.reason
