"""A cylinder with a dense ellipsoid in a few noisy projections; `conftest.py` provides them as fixtures."""

from __future__ import annotations

import numpy as np

import recon

SHAPE, PITCH = (20, 40), 0.1
ANGLES = np.linspace(0, np.pi, 24, endpoint=False)
VIEWS = recon.Geometry.parallel(ANGLES, SHAPE, pixel_pitch=PITCH, axis_col=18.3)
GRID = recon.Grid.matching(VIEWS)
