"""Values that all of recon shares: geometry, grid, volume, projections, masks and the ray model."""
