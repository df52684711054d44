"""Tomographic reconstruction: arrays in, arrays out. `recon.reconstruct` and `recon.Geometry` are the public names."""

from __future__ import annotations

import os

# libgomp reads this when it is loaded: without it idle threads spin, and two processes that share the cores
# (a scan and its live reconstruction) slow each other down twentyfold.
os.environ.setdefault("GOMP_SPINCOUNT", "2000")

import torch  # noqa: F401 - before any numba kernel runs: the other order makes torch's operators 20x slower

from recon.geometry import Geometry
from recon.reconstruct import Reconstruction, reconstruct
from recon.volume import Grid, Volume

__all__ = ["Geometry", "Grid", "Reconstruction", "Volume", "reconstruct"]
