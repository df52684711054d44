"""Simulated Zaber device."""
