"""Configuration of the rotation stage: one section per kind of stage, with the keys that its settings declare.

To add a stage, add its folder `drivers/stages/<kind>` with a module `stage` that contains the driver. DRIVERS in the
folder must name the driver.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Self, Union
from zlib import crc32

from pydantic import model_validator

from beamline.config.section import Port, Section, declared, read_from, section_of
from beamline.core.machine import state_folder
from drivers.base.clock import Clock
from drivers.base.protocols import RotationStage
from drivers.stages.settings import StageDriver, StageSettings, with_settings
from drivers.stages.shared import LineStage
from recon.base.registry import Registry, in_folders
from recon.base.setting import setting

STAGES: Registry[StageDriver] = Registry(
    "stage",
    {
        kind: getattr(import_module(f"drivers.stages.{kind}.stage"), name)
        for kind, name in in_folders("drivers.stages", "DRIVERS").items()
    },
    with_settings,
)
"""For each kind of stage, as a configuration names it, the driver."""

_IDENTITY = ("model", "serial", "device", "axis", "channel")


def settings_file(description: Mapping[str, object], folder: Path) -> Path:
    """File for the settings of the stage with this description. Its name has the serial number of the stage, or the
    port if the stage reports no serial number.
    """
    which = [str(description[key]) for key in _IDENTITY if key in description]
    if "serial" not in description:
        which.append(str(description.get("port")))
    name = re.sub(r"\W+", "-", " ".join(which)).strip("-")[:60]
    return folder / f"{name}-{crc32(json.dumps(which, allow_nan=False).encode()):08x}.json"


class StageSection(Section):
    """Keys that all stages share. Examples of real ports: COM3, /dev/ttyUSB0, /dev/serial/by-id/...,
    socket://host:port."""

    kind: str
    port: Port = setting(
        doc=(
            "Address of the controller. sim:// followed by the kind of the stage: a simulated controller, if this "
            "kind can be simulated. The simulated controller uses all other settings of this section."
        )
    )

    @model_validator(mode="after")
    def _sensible(self) -> Self:
        low, high = (getattr(self, key) for key in ("low_deg", "high_deg"))
        if not low < high:
            raise ValueError(f"low_deg {low} must lie below high_deg {high}")
        if self.simulated and (stand_in := STAGES[self.kind].Settings.stand_in):
            raise ValueError(
                f"a {self.kind} stage has no simulated controller, so {self.port} is not a valid port. "
                f"Simulate a stage with kind: {stand_in}, port: sim://{stand_in}, or set the real port and "
                "rehearse with --rehearse"
            )
        if self.simulated and self.port.lower() != f"sim://{self.kind}":
            raise ValueError(
                f"port {self.port} does not fit kind {self.kind}; expected sim://{self.kind}, the "
                "simulated controller of this kind"
            )
        _ = self.settings
        return self

    @property
    def simulated(self) -> bool:
        return self.port.lower().startswith("sim://")

    @property
    def settings(self) -> StageSettings:
        """The settings with which the driver is opened."""
        return read_from(self, STAGES[self.kind].Settings)

    def connect(self, clock: Clock, url: str | None = None) -> RotationStage:
        """Connect the driver at the port, or at `url`; see `StageDriver`. Settings of a real stage are kept on disk."""
        stage = STAGES[self.kind](url or self.port, self.settings, clock)
        try:
            if isinstance(stage, LineStage) and not (url or self.port).lower().startswith("sim://"):
                stage.keep_found_settings(settings_file(stage.describe(), state_folder() / "stages"))
        except BaseException:
            stage.close()
            raise
        return stage

    def halt(self, clock: Clock) -> None:
        """Stop the stage; see `StageDriver`."""
        STAGES[self.kind].halt(self.port, self.settings, clock)


def _section(kind: str) -> type[StageSection]:
    settings = STAGES[kind].Settings
    name, doc = settings.__name__.replace("Settings", "StageConfig"), (settings.__doc__ or "").partition("\n")[0]
    return section_of(name, StageSection, {"kind": (Literal[kind], ...)} | declared(settings), doc)


STAGE_SECTIONS: Mapping[str, type[StageSection]] = {kind: _section(kind) for kind in STAGES}
"""For each kind, its section of the configuration."""

if TYPE_CHECKING:
    StageConfig = StageSection
else:
    _NONE = section_of(
        "NoStageConfig", StageSection, {"kind": (Literal["the name of an installed kind of stage"], ...)}
    )
    StageConfig = Union[tuple(STAGE_SECTIONS.values()) or _NONE]  # noqa: UP007 - a union of as many as there are
