"""Calibration: geometry and pixel sensitivities, found from the projections themselves."""

STEPS = {"Calibrate": "calibration.calibrate"}
