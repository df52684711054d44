"""Configuration of a shutter with settings."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, PositiveInt

from beamline.config.section import Section
from drivers.base.clock import Clock
from drivers.base.protocols import ConnectedShutter


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
