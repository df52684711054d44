"""Shutter, filter and monochromator behind EPICS process variables."""

from __future__ import annotations

from beamline.config.families.epics.sections import EpicsFilter, EpicsMonochromator, EpicsShutter

SHUTTERS, FILTERS, MONOCHROMATORS = {"epics": EpicsShutter}, {"epics": EpicsFilter}, {"epics": EpicsMonochromator}
