"""Samples of voxels: volumes and meshes that are read from files."""

from __future__ import annotations

PHANTOMS = {name: f"{__name__}.{name}" for name in ("volume", "mesh")}
