"""Simulated controllers at the far end of a wire: one folder a controller."""
