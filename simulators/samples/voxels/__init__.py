"""Samples of voxels: volumes and meshes that are read from files."""

from __future__ import annotations

PHANTOMS = dict.fromkeys(("volume", "mesh"), f"{__name__}.files")
