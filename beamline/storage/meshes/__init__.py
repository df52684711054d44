"""Meshes of a scene."""

from __future__ import annotations

MESHES = dict.fromkeys((".stl", ".ply", ".obj"), f"{__name__}.reading")
"""Suffix -> the module that reads such a file."""
