"""Placement of projections: defaults and errors."""

from __future__ import annotations

from typing import Any

import numpy as np

from recon.base.geometry import Geometry
from recon.voxels.direct import fdk
from recon.voxels.fbp import fbp
from tests.messages import refused
from tests.refused_calls import refused_calls


def test_an_axis_is_never_taken_for_a_pitch() -> None:
    """What a user may leave out has a name: a third number was the pitch, and meant as the axis."""
    given: Any = ([0.0], (4, 96), 47.5)
    with refused(TypeError):
        Geometry.parallel(*given)
    for cone in ((*given, 50.0, 70.0, 47.5), ([0.0], 96, 0.5, 50.0, 70.0, 47.5)):
        with refused(TypeError):
            (Geometry.cone if cone[1] == (4, 96) else Geometry.fan)(*cone)


def test_the_axis_is_in_the_middle_unless_told() -> None:
    assert Geometry.parallel([0.0], (4, 10)).axis_col == 4.5
    assert Geometry.parallel([0.0], (4, 10), axis_col=3.2).axis_col == 3.2


def test_distances_that_float32_does_not_hold_are_refused() -> None:
    """FDK from 1e20 mm gave zeros; the farthest that is taken gives what a parallel beam does."""
    with refused(ValueError):
        Geometry.cone([0.0], (4, 4), 1.0, 1e20, 1e20)
    with refused(ValueError):
        Geometry.cone([0.0], (4, 4), 1.0, 1e-9, 1e9)
    angles, sinogram = np.linspace(0, 2 * np.pi, 40, endpoint=False), np.zeros((40, 4, 16), np.float32)
    sinogram[:, :, 5:11] = 1
    far, parallel = Geometry.cone(angles, (4, 16), 1.0, 1e9, 1e9), Geometry.parallel(angles, (4, 16))
    expected = fbp(sinogram, parallel)
    np.testing.assert_allclose(fdk(sinogram, far), expected, atol=0.03 * np.abs(expected).max())


test_calls_that_are_refused = refused_calls(__file__, globals())
