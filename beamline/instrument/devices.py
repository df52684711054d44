"""Devices: a configured camera or beam monitor becomes its driver; waits for a cold sensor before a scan."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from beamline.config.devices import DcamOrca, ElectrometerConfig, EpicsBeamConfig, RingCurrentConfig
from beamline.instrument.simulated import simulated_electrometer
from drivers.base.clock import Clock
from drivers.base.protocols import BeamMonitor
from drivers.beam_monitors.page import PageSource
from drivers.beam_monitors.reading import TextBeamMonitor, TextSource
from drivers.beam_monitors.serial import ElectrometerQuery, SerialSource
from drivers.epics.devices import PvSource
from drivers.frame_memory import FrameMemory

if TYPE_CHECKING:
    from drivers.dcam.camera import DcamCamera
    from drivers.dcam.options import DcamOptions

TELL_EVERY = 30.0  # s between messages on a sensor that is cooling down


def make_camera(config: DcamOrca, clock: Clock, memory: FrameMemory | None = None) -> DcamCamera:
    """The driver of the configured camera, connected. `memory`: of the frames that it gives.

    Raises:
        DeviceError: no library, no camera, or it does not count its frames.
    """
    from drivers.dcam.camera import DcamCamera

    library = None if config.library is None else Path(config.library)
    return DcamCamera(library, config.index, clock=clock, options=options_of(config), memory=memory)


def wait_until_cold(camera: DcamCamera, seconds: float, clock: Clock, check_stop: Callable[[], None]) -> None:
    """Wait for a cold sensor and tell the operator how cold it is.

    Args:
        seconds: at most.
        check_stop: called once a second; its exception ends the wait.

    Raises:
        DeviceError: the sensor does not get cold, or its cooler is off or in trouble.
    """
    click.echo(f"Waiting for a cold sensor, at most {seconds:g} s; Ctrl-C ends it.", err=True)
    told = -math.inf

    def progress(celsius: float, status: str) -> None:
        nonlocal told
        check_stop()
        if clock.now() - told >= TELL_EVERY:
            told = clock.now()
            click.echo(f"The sensor has {celsius:.1f} °C, its cooler says {status}.", err=True)

    camera.wait_until_cold(seconds, progress)


def options_of(camera: DcamOrca) -> DcamOptions:
    """The configuration in the driver's terms."""
    from drivers.dcam import options

    return options.DcamOptions(
        trigger_active=options.TriggerActive(camera.trigger_active),
        trigger_mode=options.TriggerMode(camera.trigger_mode),
        trigger_polarity=options.TriggerPolarity(camera.trigger_polarity),
        global_exposure=options.GlobalExposure(camera.global_exposure),
        trigger_times=camera.trigger_times,
        trigger_delay=camera.trigger_delay_s,
        hot_pixels=None if camera.hot_pixels is None else options.HotPixelMode(camera.hot_pixels),
        exposure_tolerance=camera.exposure_tolerance,
        ring_bytes=camera.ring_mb * 1_000_000,
    )


def make_beam_monitor(config: ElectrometerConfig | RingCurrentConfig | EpicsBeamConfig, clock: Clock) -> BeamMonitor:
    """The beam monitor that is configured; the simulated electrometer shows a steady current.

    Raises:
        DeviceError: the electrometer's port does not open.
    """
    source: TextSource
    pattern = "(.*)" if isinstance(config, EpicsBeamConfig) else config.pattern
    if isinstance(config, EpicsBeamConfig):
        source = PvSource(config.pv, config.timeout_s)
    elif isinstance(config, RingCurrentConfig):
        source = PageSource(config.url, clock, timeout=config.timeout_s)
    else:
        end = {"crlf": b"\r\n", "cr": b"\r", "lf": b"\n"}[config.line_end]
        source = SerialSource(
            simulated_electrometer(clock, end) if config.simulated else config.port,
            clock,
            ElectrometerQuery(config.query, config.pattern, config.setup, end),
            timeout=config.timeout_s,
            baudrate=config.baudrate,
            transcript=None if config.transcript is None else Path(config.transcript),
        )
    return TextBeamMonitor(source, clock, pattern=pattern, unit=config.unit, scale=config.scale)
