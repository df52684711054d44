"""Cameras behind EPICS areaDetector: somebody else's scan recorded as one of ours, and ours served to others."""
