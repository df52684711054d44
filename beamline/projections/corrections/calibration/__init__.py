"""Geometry and gains learnt from the views themselves."""

from __future__ import annotations

STEPS = {"Calibrate": "calibration.calibrate"}
