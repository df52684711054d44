"""Checks for faults of the detector: bands, blur, gain, zingers."""

from __future__ import annotations

CHECKS = {
    "BandsCheck": "beamline.monitor.detector.bands",
    "GainCheck": "beamline.monitor.detector.light",
    "BlurCheck": "beamline.monitor.detector.blur",
    "ZingersCheck": "beamline.monitor.detector.light",
}
