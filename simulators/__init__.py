"""Simulated devices, and the physics of the frames that they deliver."""
