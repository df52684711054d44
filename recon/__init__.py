"""Tomographic reconstruction: arrays in, arrays out. `recon.reconstruct` and `recon.Geometry` are the public names.

The values (Geometry, Grid, Volume) load at once; what computes loads torch and numba on first use, so that a program
which only plans a scan starts quickly.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from recon.base.geometry import Geometry
from recon.base.volume import Grid, Volume

# libgomp reads this when torch or numba load it: without it idle threads spin, and two processes that share the cores
# (a scan and its live reconstruction) slow each other down twentyfold.
os.environ.setdefault("GOMP_SPINCOUNT", "2000")

if TYPE_CHECKING:
    from recon.reconstruction import Reconstruction, reconstruct

__all__ = ["Geometry", "Grid", "Reconstruction", "Volume", "reconstruct"]


def __getattr__(name: str) -> Any:
    if name in ("Reconstruction", "reconstruct"):
        from recon import reconstruction

        return getattr(reconstruction, name)
    raise AttributeError(f"module 'recon' has no attribute {name!r}")
