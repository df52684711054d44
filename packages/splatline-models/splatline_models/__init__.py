"""Voxels of any size and projections from the Gaussians of a fit, and the surface mesh of a volume."""
