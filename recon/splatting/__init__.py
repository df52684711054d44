"""R²-Gaussian: reconstruction of a volume as a sum of Gaussians that is fitted to the projections."""
