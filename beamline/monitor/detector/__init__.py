"""Checks for faults of the detector: bands, blur, gain, zingers."""

from __future__ import annotations

CHECKS = {
    "beamline.monitor.detector.bands": "BandsCheck",
    "beamline.monitor.detector.gain": "GainCheck",
    "beamline.monitor.detector.blur": "BlurCheck",
    "beamline.monitor.detector.zingers": "ZingersCheck",
}
