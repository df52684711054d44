"""Beam monitors: a configured electrometer or page becomes its driver."""

from __future__ import annotations

from pathlib import Path

from beamline.config.devices import ElectrometerConfig, RingCurrentConfig
from beamline.instrument.simulated import simulated_electrometer
from drivers.base.clock import Clock
from drivers.base.protocols import BeamMonitor
from drivers.beam_monitors.page import PageSource
from drivers.beam_monitors.reading import TextBeamMonitor, TextSource
from drivers.beam_monitors.serial import SerialSource


def make_beam_monitor(config: ElectrometerConfig | RingCurrentConfig, clock: Clock) -> BeamMonitor:
    """The beam monitor that is configured; the simulated electrometer shows a steady current.

    Raises:
        DeviceError: the electrometer's port does not open.
    """
    source: TextSource
    if isinstance(config, RingCurrentConfig):
        source = PageSource(config.url, clock, timeout=config.timeout_s)
    else:
        end = {"crlf": b"\r\n", "cr": b"\r", "lf": b"\n"}[config.line_end]
        source = SerialSource(
            simulated_electrometer(clock, end) if config.simulated else config.port,
            clock,
            query=config.query,
            pattern=config.pattern,
            setup=config.setup,
            timeout=config.timeout_s,
            baudrate=config.baudrate,
            line_end=end,
            transcript=None if config.transcript is None else Path(config.transcript),
        )
    return TextBeamMonitor(source, clock, pattern=config.pattern, unit=config.unit, scale=config.scale)
