"""Simulated PI controller, GCS 2.0."""
