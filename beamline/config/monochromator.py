"""Configuration of the monochromator: simulated, by hand, or of a family of devices."""

from __future__ import annotations

from contextlib import closing
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from beamline.config.section import Section
from drivers.base.clock import Clock
from drivers.base.protocols import ConnectedMonochromator

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
