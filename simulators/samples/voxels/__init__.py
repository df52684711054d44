"""Samples made of voxels: volumes that are read from files."""

PHANTOMS = {"volume": f"{__name__}.voxels"}
