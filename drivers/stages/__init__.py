"""Rotation stages: one folder per controller."""
