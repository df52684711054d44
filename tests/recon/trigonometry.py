"""The position of a point on the detector, computed only with trigonometry."""

from __future__ import annotations

import numpy as np

from recon.base.geometry import Geometry


def pixel_of(geometry: Geometry, view: int, point: np.ndarray) -> np.ndarray:
    """The pixel of a point, with the trigonometry of `recon.base.geometry` written out without matrices."""
    x, y, z = point
    c, s = np.cos(geometry.angles[view]), np.sin(geometry.angles[view])
    u, v, along = x * c + y * s, z, -x * s + y * c
    t, r = geometry.tilt[view], geometry.roll[view]
    v, along = v * np.cos(t) + along * np.sin(t), along * np.cos(t) - v * np.sin(t)
    u, v = u * np.cos(r) + v * np.sin(r), v * np.cos(r) - u * np.sin(r)
    enlarged = geometry.sdd / (geometry.sod + along) if geometry.is_cone else 1.0
    col, row = geometry.shifts[view]
    return np.array(
        [geometry.axis_col + col + enlarged * u / geometry.pixel_pitch,
         geometry.axis_row + row + enlarged * v / geometry.pixel_pitch]
    )  # fmt: skip
