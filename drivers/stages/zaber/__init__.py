"""Zaber rotary stages (ASCII protocol)."""

DRIVERS = {"zaber": "ZaberStage"}
