"""An EPICS motor record as a rotation stage."""

DRIVERS = {"epics": "EpicsStage"}
