"""Configuration of devices behind EPICS process variables, each as pva://NAME or ca://NAME."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from beamline.config.beam import FoundMonochromator, FoundShutter
from beamline.config.places import FoundFilter, Name, refuse_equal
from beamline.config.section import declared, read_from, section_of, without
from drivers.base.clock import Clock
from drivers.epics.channel import url_problem
from drivers.epics.devices import (
    FilterPvs,
    MonochromatorPvs,
    PvFilter,
    PvMonochromator,
    PvShutter,
    ShutterPvs,
)

PvUrl = Annotated[str, without(url_problem)]
Seconds = Annotated[float, Field(gt=0, le=1e6)]


class EpicsShutter(section_of("EpicsShutterKeys", FoundShutter, declared(ShutterPvs))):  # type: ignore[misc]
    """A shutter behind EPICS process variables."""

    kind: Literal["epics"]

    @property
    def pvs(self) -> ShutterPvs:
        """In the driver's terms."""
        pvs: ShutterPvs = read_from(self, ShutterPvs)
        return pvs

    def connect(self, clock: Clock) -> PvShutter:
        """See `FoundShutter`."""
        return PvShutter(self.pvs, clock)


class EpicsFilter(FoundFilter):
    """Filters behind EPICS process variables, each as pva://NAME or ca://NAME."""

    kind: Literal["epics"]
    pv: PvUrl
    """Takes the value of a place: a number, a text or a label."""
    status_pv: PvUrl | None = None
    """Where the filter itself is read, with the same values; null: pv."""
    places: Annotated[dict[Name, float | str], Field(min_length=1)]
    """Name: value."""
    timeout_s: Seconds = 2.0
    """For an answer of the IOC."""
    travel_s: Seconds = 30.0
    """The longest that the status may take to follow."""

    @model_validator(mode="after")
    def _one_value_a_place(self) -> Self:
        refuse_equal(self.places)
        return self

    def connect(self, clock: Clock) -> PvFilter:
        """See `FoundFilter`."""
        status = self.status_pv or self.pv
        return PvFilter(FilterPvs(self.pv, status, self.places, self.timeout_s, self.travel_s), clock)


class EpicsMonochromator(FoundMonochromator):
    """A monochromator behind EPICS process variables, each as pva://NAME or ca://NAME."""

    kind: Literal["epics"]
    pv: PvUrl
    """Takes the energy."""
    status_pv: PvUrl
    """Where the energy itself is read."""
    stop_pv: PvUrl | None = None
    """Takes a 1 that stops it; null: it cannot be stopped."""
    unit: Literal["keV", "eV"] = "keV"
    """Of pv and status_pv."""
    tolerance_ev: Annotated[float, Field(gt=0, le=1e4)] = 0.5
    """Most difference of the energy from the one that was asked for."""
    settle_s: Annotated[float, Field(ge=0, le=1e6)] = 1.0
    """Time that it must stay within tolerance_ev before the move has ended."""
    timeout_s: Seconds = 2.0
    """Longest wait for an answer of the IOC."""
    travel_s: Seconds = 60.0
    """The longest that a move may take."""

    @property
    def stops(self) -> bool:
        return self.stop_pv is not None

    def connect(self, clock: Clock) -> PvMonochromator:
        """See `FoundMonochromator`."""
        pvs = MonochromatorPvs(
            self.pv, self.status_pv, self.stop_pv, per_kev=1e3 if self.unit == "eV" else 1.0,
            tolerance=self.tolerance_ev * 1e-3, settle=self.settle_s, timeout=self.timeout_s, travel=self.travel_s,
        )  # fmt: skip
        return PvMonochromator(pvs, clock)
