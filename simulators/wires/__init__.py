"""Simulated controllers at the other end of a serial cable: one folder per controller."""
