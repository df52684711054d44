"""The Gaussians behind a volume."""
