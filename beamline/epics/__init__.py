"""EPICS: the state of a run as process variables."""
