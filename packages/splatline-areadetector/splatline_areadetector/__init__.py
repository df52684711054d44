"""Cameras behind EPICS areaDetector."""
