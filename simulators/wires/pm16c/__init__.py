"""Simulated Tsuji PM16C-04XD."""

CONTROLLERS = {"pm16c": "PM16CBuild"}
