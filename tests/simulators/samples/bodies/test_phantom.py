"""Phantom: how far its matter reaches, against the widest shadow over all angles."""

from __future__ import annotations

import numpy as np
import pytest

from simulators.frame.detector import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Cylinder, Ellipsoid
from tests.simulators.bodies import SOLIDS


def _widest_shadow(phantom: Phantom, detector: Detector) -> float:
    """Over a turn, the largest |u| of a pixel that a body shadows: some view looks across the farthest point."""
    u = np.abs(detector.u())
    views = (phantom.line_integrals(angle, detector) for angle in np.linspace(0, 2 * np.pi, 120, endpoint=False))
    return max(float(u[(view > 0).any(axis=0)].max()) for view in views)


@pytest.mark.parametrize("name", SOLIDS)
def test_the_radius_is_the_widest_shadow(name: str) -> None:
    pitch = 2e-3
    phantom = Phantom.of([SOLIDS[name]])
    # A corner may lie between two rows or two angles.
    widest = _widest_shadow(phantom, Detector.centred((300, 601), pitch))
    loose = 0.1 if isinstance(SOLIDS[name], Ellipsoid) else 0.01
    assert widest - pitch <= phantom.radius <= (1 + loose) * widest


def test_the_radius_is_of_the_farthest_solid_and_0_without_solids() -> None:
    can = Cylinder(0.5, 1.0, 1.0)
    assert Phantom.of([can]).radius == 0.5  # not the corner of the box around it
    assert Phantom.of([can, Ellipsoid((0.1, 0.1, 0.1), 1.0, (3.0, 4.0, 0.0))]).radius == pytest.approx(5.1)
    assert Phantom.of([]).radius == 0.0
