"""Samples that are volumes of voxels."""
