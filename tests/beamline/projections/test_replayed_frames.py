"""The values that the monitor has from a file before its first frame."""

from __future__ import annotations

import numpy as np
import pytest

from beamline.projections.replayed_frames import context_of
from tests.beamline.array_source import ArraySource


@pytest.mark.parametrize(("level", "expected"), [(4095, 4095.0), (4000, 65535.0), (65535, 65535.0)])
def test_the_end_of_the_range_is_where_pixels_pile_up(level: int, expected: float) -> None:
    data = np.full((4, 8, 40), level, np.uint16)
    assert context_of(ArraySource(data, [1, 1, 0, 0], np.zeros(4))).saturation == expected
