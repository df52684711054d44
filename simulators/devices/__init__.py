"""Simulated devices: camera, shutter, motor, trigger line, clock."""
