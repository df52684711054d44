"""Configuration of the beam monitor: the keys that all kinds share."""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, Literal, Self

from pydantic import Field, PositiveFloat, model_validator

from beamline.config.section import Section
from drivers.base.clock import Clock
from drivers.base.protocols import BeamMonitor


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
