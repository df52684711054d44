"""Binned pixels compared with explicit sums, and with the geometry of binned pixels."""

from __future__ import annotations

import numpy as np
import pytest

from recon.base.arrays import bin_views
from recon.base.geometry import Geometry


def test_binned_pixels_are_means() -> None:
    views = np.arange(2 * 5 * 7, dtype=np.float32).reshape(2, 5, 7)
    out = bin_views(views, 2)
    assert out.shape == (2, *Geometry.parallel([0.0, 1.0], (5, 7)).binned(2).detector_shape)
    for j in range(2):
        for i in range(3):
            np.testing.assert_allclose(out[:, j, i], views[:, 2 * j : 2 * j + 2, 2 * i : 2 * i + 2].mean(axis=(1, 2)))
    assert bin_views(views, 1) is views


@pytest.mark.parametrize("factor", [0, 6])
def test_bins_that_do_not_fit(factor: int) -> None:
    with pytest.raises(ValueError, match="between 1 and 5"):
        bin_views(np.zeros((1, 5, 7), np.float32), factor)
