"""Calibration: what a scan does not state of its geometry, learnt from its views together with the volume."""
