"""Surfaces where a volume, or the Gaussians behind it, cross a level."""
