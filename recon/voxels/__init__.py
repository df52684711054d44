"""Reconstruction on voxels: filtered back-projection and iterative methods."""
