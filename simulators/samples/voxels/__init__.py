"""Samples of voxels: volumes and meshes that are read from files."""

PHANTOMS = dict.fromkeys(("volume", "mesh"), f"{__name__}.files")
