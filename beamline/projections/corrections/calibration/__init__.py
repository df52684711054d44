"""Geometry and gains learnt from the views themselves."""

STEPS = {"Calibrate": "calibration.calibrate"}
