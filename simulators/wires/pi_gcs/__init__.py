"""Simulated PI controller, GCS 2.0."""

CONTROLLERS = {"pi_gcs": "PiGcsBuild"}
