"""Simulated Zaber device."""

CONTROLLERS = {"zaber": "ZaberBuild"}
