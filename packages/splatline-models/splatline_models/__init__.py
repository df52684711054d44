"""What else the Gaussians behind a volume give: voxels of any size, views; and the surface of a volume."""
