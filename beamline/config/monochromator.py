"""Configuration of the monochromator: simulated, by hand, or behind EPICS process variables."""

from __future__ import annotations

from contextlib import closing
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from beamline.config.places import PvUrl, Seconds
from beamline.config.section import Section
from drivers.base.clock import Clock
from drivers.epics.devices import MonochromatorPvs, PvMonochromator

Kev = Annotated[float, Field(gt=0, le=1e6)]


class NoMonochromator(Section):
    kind: Literal["none"] = "none"


class _Monochromator(Section):
    range_kev: tuple[Kev, Kev] | None = None
    """Lowest and highest energy that a scan may ask for; null: any."""

    @model_validator(mode="after")
    def _range_rises(self) -> Self:
        if self.range_kev is not None and self.range_kev[0] > self.range_kev[1]:
            low, high = self.range_kev
            raise ValueError(f"range_kev is {low:g} ... {high:g}; expected the lower energy first")
        return self


class SceneMonochromator(_Monochromator):
    """Sets the energy of the simulated beam; it begins at that of the scene."""

    kind: Literal["simulated"]
    settle_s: Annotated[float, Field(ge=0, le=1e6)] = 1.0
    """Time that each move takes."""


class HandMonochromator(_Monochromator):
    """The operator is asked to set it."""

    kind: Literal["manual"]


class EpicsMonochromator(_Monochromator):
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

    def connect(self, clock: Clock) -> PvMonochromator:
        """The device, connected. Nothing moves. Raises DeviceError: it does not answer."""
        pvs = MonochromatorPvs(
            self.pv, self.status_pv, self.stop_pv, per_kev=1e3 if self.unit == "eV" else 1.0,
            tolerance=self.tolerance_ev * 1e-3, settle=self.settle_s, timeout=self.timeout_s, travel=self.travel_s,
        )  # fmt: skip
        return PvMonochromator(pvs, clock)

    def halt(self, clock: Clock) -> None:
        """Stop it. Raises DeviceError."""
        with closing(self.connect(clock)) as connected:
            connected.stop()


MonochromatorConfig = NoMonochromator | SceneMonochromator | HandMonochromator | EpicsMonochromator
