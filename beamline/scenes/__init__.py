"""Scenes: their files and their ground truth, for all features that use them."""
