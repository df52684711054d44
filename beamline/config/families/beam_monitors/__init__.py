"""The section of each kind of beam monitor, which also connects the driver."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar, Literal

from beamline.config.beam import BeamMonitorSection
from beamline.config.section import Port
from drivers.base.clock import Clock
from drivers.beam_monitors import (
    PATTERN,
    QUERY,
    ElectrometerQuery,
    PageSource,
    SerialSource,
    TextBeamMonitor,
    pattern_problem,
    url_problem,
)
from drivers.epics.channel import url_problem as pv_problem
from drivers.epics.devices import PvSource
from recon.base.setting import Setting, setting

Pattern = Annotated[str, Setting(problem=pattern_problem)]
PvUrl = Annotated[str, Setting(problem=pv_problem)]


class ElectrometerConfig(BeamMonitorSection):
    """An electrometer or picoammeter on a serial port that answers a query with a line containing a number."""

    counterpart: ClassVar[str | None] = "electrometer"

    kind: Literal["electrometer"]
    port: Port = setting(doc="A serial port, socket://host:port, or sim://electrometer.")
    query: str = setting(QUERY, min_length=1)
    pattern: Pattern = setting(PATTERN, "Regular expression for the reply; its first group must match the number.")
    unit: str = "A"
    setup: tuple[str, ...] = setting(
        (), "Commands that the device does not answer; the program sends them once, when it connects."
    )
    line_end: Literal["crlf", "cr", "lf"] = "crlf"
    baudrate: int = setting(9600, gt=0)
    transcript: str | None = setting(None, "As for the stage.")

    @property
    def simulated(self) -> bool:
        return self.port.lower().startswith("sim://")

    @property
    def end(self) -> bytes:
        """The line ending, in both directions."""
        return {"crlf": b"\r\n", "cr": b"\r", "lf": b"\n"}[self.line_end]

    def connect(self, clock: Clock, url: str | None = None) -> TextBeamMonitor:
        source = SerialSource(
            url or self.port,
            clock,
            ElectrometerQuery(self.query, self.pattern, self.setup, self.end),
            timeout=self.timeout_s,
            baudrate=self.baudrate,
            transcript=None if self.transcript is None else Path(self.transcript),
        )
        return TextBeamMonitor(source, clock, pattern=self.pattern, unit=self.unit, scale=self.scale)


class RingCurrentConfig(BeamMonitorSection):
    """The ring current, read from a web page or a text file."""

    kind: Literal["ring_current"]
    url: Annotated[str, Setting(problem=url_problem)] = setting(doc="http://..., https://... or file:///...")
    pattern: Pattern = setting(doc="Regular expression for the reply; its first group must match the number.")
    unit: str = "mA"

    def connect(self, clock: Clock, url: str | None = None) -> TextBeamMonitor:
        source = PageSource(url or self.url, clock, timeout=self.timeout_s)
        return TextBeamMonitor(source, clock, pattern=self.pattern, unit=self.unit, scale=self.scale)


class EpicsBeamConfig(BeamMonitorSection):
    """The ring current, or an intensity, read from an EPICS process variable."""

    kind: Literal["epics"]
    pv: PvUrl = setting(doc="pva://NAME or ca://NAME.")
    unit: str = "mA"

    def connect(self, clock: Clock, url: str | None = None) -> TextBeamMonitor:
        source = PvSource(url or self.pv, self.timeout_s)
        return TextBeamMonitor(source, clock, pattern="(.*)", unit=self.unit, scale=self.scale)


BEAM_MONITORS = {"electrometer": ElectrometerConfig, "ring_current": RingCurrentConfig, "epics": EpicsBeamConfig}
