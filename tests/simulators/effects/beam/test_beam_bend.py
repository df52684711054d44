"""Beam bend: the open beam of the views against that of the flats."""

from __future__ import annotations

import numpy as np
import pytest

from simulators.effects.beam.beam_bend import BeamBend
from tests.simulators import shots

BEND = BeamBend(curvature=(0.04, -0.02), level=-0.01, drift=1e-4)


def test_views_have_the_stated_surface_of_line_integrals() -> None:
    shot = shots.shot(sample=True, elapsed=50.0)
    left = -np.log(BEND.apply(np.ones((61, 81)), shot))
    assert left[30, 40] == pytest.approx(-0.01 + 1e-4 * 50)
    np.testing.assert_allclose(left[30] - left[30, 40], 0.04 * (2 * (np.arange(81) - 40) / 81) ** 2, atol=1e-12)
    np.testing.assert_allclose(left[:, 40] - left[30, 40], -0.02 * (2 * (np.arange(61) - 30) / 61) ** 2, atol=1e-12)


def test_flats_stay_as_they_are() -> None:
    assert (BEND.apply(np.ones((6, 8)), shots.shot(sample=False)) == 1).all()
