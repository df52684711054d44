"""Tsuji PM16C-04XD pulse-motor controller."""

DRIVERS = {"pm16c": "PM16CStage"}
