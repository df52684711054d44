"""Checks for faults of the detector: bands, blur, gain, zingers."""

CHECKS = {
    "BandsCheck": "beamline.monitor.detector.bands",
    "GainCheck": "beamline.monitor.detector.light",
    "BlurCheck": "beamline.monitor.detector.blur",
    "ZingersCheck": "beamline.monitor.detector.light",
}
