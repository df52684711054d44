"""Calibration: measures the geometry and the pixel sensitivities from the projections, together with the volume."""
