"""Methods of several volumes refuse what shows no matter, as methods of one volume do."""

from __future__ import annotations

import numpy as np
import pytest

import recon
from recon import DataUse, Geometry

VIEWS = Geometry.parallel(np.linspace(0, np.pi, 40, endpoint=False), (2, 8), pixel_pitch=1.0)
ONES = np.ones((40, 2, 8), np.float32)


@pytest.mark.parametrize(
    ("data", "weights"), [(0 * ONES, None), (np.nan * ONES, None), (ONES, 0 * ONES)], ids=["zero", "NaN", "no weight"]
)
def test_views_without_matter_are_refused(data: np.ndarray, weights: np.ndarray | None) -> None:
    with pytest.raises(ValueError, match="show no matter"):
        recon.reconstruct(data, VIEWS, recon.TimeSeries(), use=DataUse(weights))
