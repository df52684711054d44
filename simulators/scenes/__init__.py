"""Scenes: sample, light and effects together, exposed into frames."""
