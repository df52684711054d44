"""Configuration of the rotation stage: one section per kind, with the keys that its settings declare."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Literal, Self, Union

from pydantic import Field, model_validator

from beamline.config.found_settings import keep_found_settings
from beamline.config.section import Section, declared, read_from, section_of
from drivers.base.clock import Clock
from drivers.base.protocols import RotationStage
from drivers.stages.registry import STAGES
from drivers.stages.settings import StageSettings


class StageSection(Section):
    """What every stage has. Real ports: COM3, /dev/ttyUSB0, /dev/serial/by-id/..., socket://host:port."""

    kind: str
    port: Annotated[str, Field(min_length=1)]
    """Where its controller is; sim:// and the kind is its simulated counterpart, which takes all else from here."""

    @model_validator(mode="after")
    def _sensible(self) -> Self:
        low, high = (getattr(self, key) for key in ("low_deg", "high_deg"))
        if not low < high:
            raise ValueError(f"low_deg {low} must lie below high_deg {high}")
        if self.simulated and self.port.lower() != f"sim://{self.kind}":
            raise ValueError(f"port {self.port} is not the simulated counterpart of {self.kind}, sim://{self.kind}")
        _ = self.settings
        return self

    @property
    def simulated(self) -> bool:
        return self.port.lower().startswith("sim://")

    @property
    def settings(self) -> StageSettings:
        """What the driver is opened with."""
        return read_from(self, STAGES[self.kind].Settings)

    def connect(self, clock: Clock, url: str | None = None) -> RotationStage:
        """Its driver, connected at the port, or at `url`; see `StageDriver`. A real one's settings are kept on disk."""
        stage = STAGES[self.kind](url or self.port, self.settings, clock)
        try:
            if not (url or self.port).lower().startswith("sim://"):
                keep_found_settings(stage)
        except BaseException:
            stage.close()
            raise
        return stage

    def halt(self, clock: Clock) -> None:
        """Stop it; see `StageDriver`."""
        STAGES[self.kind].halt(self.port, self.settings, clock)


def _section(kind: str) -> type[StageSection]:
    settings = STAGES[kind].Settings
    name, doc = settings.__name__.replace("Settings", "StageConfig"), (settings.__doc__ or "").partition("\n")[0]
    return section_of(name, StageSection, {"kind": (Literal[kind], ...)} | declared(settings), doc)


STAGE_SECTIONS: Mapping[str, type[StageSection]] = {kind: _section(kind) for kind in STAGES}
"""Kind -> its section of the configuration."""

if TYPE_CHECKING:
    StageConfig = StageSection
else:
    StageConfig = Union[tuple(STAGE_SECTIONS.values())]  # noqa: UP007 - a union of as many as there are
