"""Iterative methods on voxels, one a file."""
