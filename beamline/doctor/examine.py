"""Examine: every check of the instrument's computer that a configuration calls for, one after the other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from beamline.config.devices import BeamMonitorConfig, DcamOrca, ElectrometerConfig, NoBeamMonitor
from beamline.config.load import Config
from beamline.config.models import Storage
from beamline.core.free_memory import free_memory
from beamline.doctor import camera, disk
from beamline.doctor.check import Check, Verdict, of_error
from beamline.doctor.memory import memory
from beamline.doctor.needs import Needs, needs, ring_bytes
from beamline.doctor.ports import port, ports
from beamline.instrument.beam_monitors import make_beam_monitor
from beamline.scan.preflight import DryRun, dry_run
from drivers.clock import Clock
from drivers.errors import DeviceError
from drivers.serial.ports import SerialPort, serial_ports


def examine(config: Config | None, clock: Clock, *, session: bool = False, usb: Any = None) -> Iterator[Check]:
    """Look at the camera's link and library, at ports, disk and memory. Nothing moves and nothing is overwritten.

    Args:
        config: what the scan will be; None: the instrument without a plan.
        session: also ask the camera itself, which no other program may then have.
        usb: a pyusb backend; None takes the installed libusb.

    Raises:
        ConfigError: a plan, scene or device setting that cannot be. Broken limits are for `check` to say.
    """
    need = None if config is None else _needs(config, dry_run(config))
    cam = None if config is None else config.devices.camera
    if cam is None or isinstance(cam, DcamOrca):
        yield camera.link(cam, usb)
        yield camera.library(cam, session)
    else:
        for name in (camera.LINK, camera.LIBRARY):
            yield Check(name, Verdict.NOT_APPLICABLE, "The camera is simulated.")
    found = serial_ports()
    if config is None:
        yield ports(found)
    else:
        yield port("stage port", config.devices.stage.port, found)
        yield from _monitor(config.devices.beam_monitor, found, clock)
    folder = Path((Storage() if config is None else config.storage).folder)
    yield disk.room(folder, need)
    yield disk.speed(folder, need, clock)
    yield memory(free_memory(), need)


def _needs(config: Config, worked: DryRun) -> Needs:
    cam = config.devices.camera
    ring = ring_bytes(worked.timeline, cam.ring_mb * 1_000_000) if isinstance(cam, DcamOrca) else 0
    return needs(worked, ring)


def _monitor(config: BeamMonitorConfig, found: Sequence[SerialPort], clock: Clock) -> Iterator[Check]:
    """The beam monitor, where there is one: its port, and one reading, which disturbs nothing."""
    name = "beam monitor"
    if isinstance(config, NoBeamMonitor):
        return
    if isinstance(config, ElectrometerConfig):
        of_port = port(f"{name} port", config.port, found)
        yield of_port
        if of_port.verdict in (Verdict.FAILED, Verdict.NOT_APPLICABLE):
            return
    try:
        with closing(make_beam_monitor(config, clock)) as monitor:
            reading = monitor.reading()
    except DeviceError as error:
        yield of_error(name, error, "a reading")
        return
    values = {"value": reading.value, "unit": reading.unit}
    yield Check(name, Verdict.OK, f"{reading.value:.6g} {reading.unit}.", "a reading", values=values)
