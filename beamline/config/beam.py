"""Configuration of what stands in the beam: its monitor, shutters and the monochromator."""

from __future__ import annotations

from abc import abstractmethod
from contextlib import closing
from typing import TYPE_CHECKING, Annotated, Literal, Self

from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from beamline.config.section import Section
from drivers.base.clock import Clock
from drivers.base.protocols import BeamMonitor, ConnectedMonochromator, ConnectedShutter


class BeamMonitorSection(Section):
    """Keys that all beam monitors share. The kinds are in folders of `beamline.config`, by their BEAM_MONITORS."""

    unit: str
    scale: PositiveFloat = 1.0
    """What the number is multiplied by to be in `unit`."""
    timeout_s: Annotated[float, Field(gt=0, le=1e6)] = 2.0
    period_s: Annotated[float, Field(gt=0, le=1e6)] = 1.0
    """Between readings while a scan runs (real time); they are kept in the scan's file."""
    pause_below: PositiveFloat | None = None
    """In `unit`: a scan pauses while there is less; null: it never does."""
    resume_above: PositiveFloat | None = None
    """In `unit`: from here on there is beam again; null: a tenth above pause_below."""
    settle_s: Annotated[float, Field(ge=0)] = 5.0
    """For which there must be beam again before the scan goes on."""

    @model_validator(mode="after")
    def _resumes_where_it_would_not_pause(self) -> Self:
        if self.pause_below is None and self.resume_above is not None:
            raise ValueError("resume_above needs pause_below: set both, or neither")
        if self.pause_below is not None and self.resumes_at < self.pause_below:
            raise ValueError(f"resume_above {self.resumes_at:g} is below pause_below {self.pause_below:g}")
        return self

    @property
    def resumes_at(self) -> float:
        """Intensity in `unit` from which a paused scan resumes."""
        return self.resume_above or 1.1 * (self.pause_below or 0.0)

    @property
    def counterpart(self) -> str | None:
        """Name of its simulated counterpart, at the port sim:// with this name; None: it has none."""
        return None

    @property
    def simulated(self) -> bool:
        return False

    @abstractmethod
    def connect(self, clock: Clock, url: str | None = None) -> BeamMonitor:
        """The beam monitor, or its simulated counterpart at `url`. DeviceError: it cannot be opened."""


class NoBeamMonitor(Section):
    kind: Literal["none"] = "none"

    @property
    def counterpart(self) -> None:
        """There is nothing to simulate."""

    @property
    def simulated(self) -> bool:
        return False


class StageOutputShutter(Section):
    """A shutter on a digital output of the stage's controller, where that has outputs that can be set."""

    kind: Literal["stage_output"]
    output: PositiveInt
    """Number of the output; not the one that the trigger pulses come from."""
    open_high: bool = True
    """A high output opens."""
    settle_s: Annotated[float, Field(ge=0)] = 0.1
    """How long the blade travels."""


class FoundShutter(Section):
    """A shutter of a family of devices, see `beamline.config.families`."""

    if TYPE_CHECKING:
        kind: str

    def connect(self, clock: Clock) -> ConnectedShutter:
        """The shutter, connected. Nothing moves. Raises DeviceError: it does not answer."""
        raise NotImplementedError


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
            raise ValueError(f"range_kev is {low:g} ... {high:g}; give the lower energy first")
        return self


class SceneMonochromator(_Monochromator):
    """Sets the energy of the simulated beam; it begins at that of the scene."""

    kind: Literal["simulated"]
    settle_s: Annotated[float, Field(ge=0, le=1e6)] = 1.0
    """Time that each move takes."""


class HandMonochromator(_Monochromator):
    """The operator is asked to set it."""

    kind: Literal["manual"]


class FoundMonochromator(_Monochromator):
    """A monochromator of a family of devices, see `beamline.config.families`."""

    kind: str

    @property
    def stops(self) -> bool:
        """Whether it can be stopped."""
        raise NotImplementedError

    def connect(self, clock: Clock) -> ConnectedMonochromator:
        """The device, connected. Nothing moves. Raises DeviceError: it does not answer."""
        raise NotImplementedError

    def halt(self, clock: Clock) -> None:
        """Stop it. Raises DeviceError."""
        with closing(self.connect(clock)) as connected:
            connected.stop()
