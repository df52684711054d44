"""Configuration of devices behind EPICS process variables, each as pva://NAME or ca://NAME."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import model_validator

from beamline.config.beam import FoundFilter, FoundMonochromator, FoundShutter, Name, refuse_equal
from beamline.config.section import declared, read_from, section_of
from drivers.base.clock import Clock
from drivers.epics.devices import (
    FilterPvs,
    MonochromatorPvs,
    PvFilter,
    PvMonochromator,
    PvShutter,
    ShutterPvs,
)
from recon.base.setting import setting

_KIND = {"kind": (Literal["epics"], ...)}


class EpicsShutter(section_of("EpicsShutterKeys", FoundShutter, declared(ShutterPvs) | _KIND)):  # type: ignore[misc]
    """A shutter behind EPICS process variables."""

    def connect(self, clock: Clock) -> PvShutter:
        """Connect the shutter, see `FoundShutter`."""
        return PvShutter(read_from(self, ShutterPvs), clock)


class EpicsFilter(section_of("EpicsFilterKeys", FoundFilter, _KIND | declared(FilterPvs))):  # type: ignore[misc]
    """Filters behind EPICS process variables, each as pva://NAME or ca://NAME."""

    places: dict[Name, float | str] = setting(doc="Name: value.", min_length=1)

    @model_validator(mode="after")
    def _one_value_a_place(self) -> Self:
        refuse_equal(self.places)
        return self

    def connect(self, clock: Clock) -> PvFilter:
        """Connect the filter, see `FoundFilter`."""
        return PvFilter(read_from(self, FilterPvs), clock)


class EpicsMonochromator(section_of("EpicsMonoKeys", FoundMonochromator, _KIND | declared(MonochromatorPvs))):  # type: ignore[misc]
    """A monochromator behind EPICS process variables, each as pva://NAME or ca://NAME."""

    @property
    def stops(self) -> bool:
        return self.stop_pv is not None

    def connect(self, clock: Clock) -> PvMonochromator:
        """Connect the monochromator, see `FoundMonochromator`."""
        return PvMonochromator(read_from(self, MonochromatorPvs), clock)


SHUTTERS, FILTERS, MONOCHROMATORS = {"epics": EpicsShutter}, {"epics": EpicsFilter}, {"epics": EpicsMonochromator}
