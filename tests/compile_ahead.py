"""Compiles the kernels of a fit while tests that need none run; numba's cache hands them to the tests that do.

Run as a process of its own, at low priority, by tests/conftest.py. Where all is in the cache it ends after seconds.
"""

from __future__ import annotations

import os
import sys

import numpy as np

from recon.geometry import Geometry
from recon.splat import RayModel
from recon.warm_up import warm_up


def main() -> None:
    if sys.platform != "win32":
        os.nice(10)
    shape, lean = (10, 20), [0, 0, 0, 0.05, 0.05, 0]
    warm_up()
    warm_up(geometry=Geometry.cone(np.linspace(0, 6, 12), shape, 0.2, 20.0, 40.0))
    leaning = Geometry.parallel(np.linspace(0, 3, 6), shape, 0.5, tilt=lean, shifts=np.full((6, 2), 0.7))
    warm_up(loss="poisson", geometry=leaning, start="tv", weighted=True)
    short = Geometry.cone(np.linspace(0, 3.6, 12), shape, 0.2, 20.0, 40.0, roll=0.02)
    warm_up(loss="l2", geometry=short, rays=RayModel(exact_above=1e-4))


if __name__ == "__main__":
    main()
