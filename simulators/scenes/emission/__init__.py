"""Scenes of a sample that emits."""
