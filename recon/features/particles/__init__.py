"""Particles of a segmented volume: parted at their necks, and measured."""
