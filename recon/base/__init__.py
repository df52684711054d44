"""Values that all of recon shares: geometry, grid and volume, views, masks, ray model."""
