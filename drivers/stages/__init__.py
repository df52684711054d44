"""Rotation stages: one folder a controller."""
