"""The views of a scan as images: those that cannot be used are left out, and a scan without any is refused."""

from __future__ import annotations

import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.features.export.film_file import views_by_angle
from tests.beamline.array_source import ArraySource


def images_of(views: int, damaged: set[int]) -> list[float]:
    light = np.array([100, 1100] + [600] * views, np.uint16)  # a dark, a flat, and the views
    frames = np.broadcast_to(light[:, None, None], (light.size, 6, 8)).copy()
    source = ArraySource(frames, [2, 1] + [0] * views, np.array([0, 0, *range(views, 0, -1)], np.float64))
    source.damaged = frozenset(damaged)
    return [float(image.mean()) for image in views_by_angle(source, 64, lambda sentence: None).read()]


def test_a_damaged_view_is_left_out() -> None:
    assert images_of(3, damaged={3}) == pytest.approx([np.log(2)] * 2, abs=1e-5)


def test_a_scan_without_a_usable_view_is_refused() -> None:
    with pytest.raises(DataError, match="can be used"):
        images_of(2, damaged={2, 3})
