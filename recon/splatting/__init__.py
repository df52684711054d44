"""R²-Gaussian: a volume as a sum of Gaussians, fitted to the views."""
