"""Scenes: sample, beam and effects together, exposed into frames."""
