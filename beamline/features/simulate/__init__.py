"""Simulated scans of a scene without an instrument: frames, labels, ground truth, and the steps that make a frame."""

COMMANDS = {
    "simulate": ("Simulate a scan of a sample with known ground truth, and write it as a scan file.", True),
}
