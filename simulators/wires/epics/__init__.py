"""A simulated motor record."""

CONTROLLERS = {"epics": "EpicsBuild"}
