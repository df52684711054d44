"""Needles: shares of Gaussians by mass, of known widths."""

from __future__ import annotations

import numpy as np
import pytest

from recon.base.geometry import Geometry
from recon.splatting.gaussians import Gaussians, needles

VIEWS = Geometry.parallel([0.0, 1.0], (8, 8), pixel_pitch=0.2)  # half a pixel is 0.1 mm


def test_mass_is_shared_among_thin_long_and_round_ones() -> None:
    widths = np.array([[0.3, 0.3, 0.3], [0.05, 1.0, 0.06], [0.09, 0.4, 0.2], [0.2, 3.0, 0.2]])
    mass = np.array([4.0, 1.0, 2.0, 3.0])  # round, needle, thin, long but resolved
    model = Gaussians.from_physical(np.zeros((4, 3)), widths, mass / widths.prod(axis=1))
    found = needles(model, VIEWS)
    assert found.thin == pytest.approx(0.3, abs=1e-5)
    assert found.share == pytest.approx(0.1, abs=1e-5)
    assert found.aspect == pytest.approx(0.4 / 0.09, rel=1e-4)
