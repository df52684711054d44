"""Configuration of beam monitors: an electrometer, a page with the ring current, an EPICS process variable."""

from __future__ import annotations

from beamline.config.families.beam_monitors.sections import ElectrometerConfig, EpicsBeamConfig, RingCurrentConfig

BEAM_MONITORS = {"electrometer": ElectrometerConfig, "ring_current": RingCurrentConfig, "epics": EpicsBeamConfig}
