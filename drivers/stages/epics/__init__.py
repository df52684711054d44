"""A motor record of EPICS as a stage."""

DRIVERS = {"epics": "EpicsStage"}
