"""Runs all checks of the instrument's computer that a configuration needs, one after the other."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from beamline.config.beam import BeamMonitorSection
from beamline.config.devices import BeamMonitorConfig, DcamOrca, FilterConfig, MonochromatorConfig
from beamline.config.load import Config
from beamline.config.models import StorageSection
from beamline.config.monochromator import FoundMonochromator
from beamline.config.places import FoundFilter, MotorFilter
from beamline.core.machine import free_memory
from beamline.core.own_packages import OWN_PACKAGES, clashing_distributions
from beamline.core.text import size
from beamline.features.doctor import devices, disk
from beamline.features.doctor.check import Diagnosis, Grade, of_error
from beamline.features.doctor.devices import port, ports
from beamline.features.doctor.disk import ScanNeeds, needs
from beamline.instrument.connect import make_beam_monitor
from beamline.scan.preflight import DryRun, dry_run
from drivers.base.clock import Clock
from drivers.base.errors import DeviceError
from drivers.base.frame import FrameKind
from drivers.serial.ports import SerialPort, serial_ports

_MEMORY, _RATE = "memory", "frame rate"


def examine(config: Config | None, clock: Clock, *, session: bool = False, usb: Any = None) -> Iterator[Diagnosis]:
    """Check the camera's link and library, ports, disk, memory, packages. Nothing moves and nothing is overwritten.

    Args:
        config: of the planned scan; None: no scan is planned.
        session: also open the camera, which no other program may use meanwhile.
        usb: a pyusb backend; None: the installed libusb.

    Raises:
        ConfigError: an impossible plan, scene or device setting. Violated limits are reported by `beamline check`.
    """
    cam, need = None, None
    if config is not None:
        worked, cam = dry_run(config), config.devices.camera
        need = needs(worked, cam.ring_mb * 1_000_000 if isinstance(cam, DcamOrca) else 0)
        yield frame_rate(worked)
    if cam is None or isinstance(cam, DcamOrca):
        yield devices.link(cam, usb)
        yield devices.library(cam, session)
    else:
        for name in (devices.LINK, devices.LIBRARY):
            yield Diagnosis(name, Grade.NOT_APPLICABLE, "The camera is simulated.")
    port_list = serial_ports()
    if config is None:
        yield ports(port_list)
    else:
        yield port("stage port", config.devices.stage.port, port_list)
        yield from _monitor(config.devices.beam_monitor, port_list, clock)
        yield from _filter(config.devices.filter, port_list, clock)
        yield from _monochromator(config.devices.monochromator, clock)
    folder = Path((StorageSection() if config is None else config.storage).folder)
    yield disk.room(folder, need)
    yield disk.locks(folder)
    yield disk.speed(folder, need, clock)
    yield memory(free_memory(), need)
    yield packages(clashing_distributions())


def packages(owners: Mapping[str, Sequence[str]]) -> Diagnosis:
    """Whether other distributions have packages of our names. Where Python finds theirs, no command starts at all.

    Args:
        owners: their names for each distribution, as of `beamline.core.own_packages.clashing_distributions`.
    """
    if not owners:
        return Diagnosis("packages", Grade.OK, f"No other distribution has a package named {', '.join(OWN_PACKAGES)}.")
    others = " ".join(
        f"The distribution {owner} also has packages named {' and '.join(names)}." for owner, names in owners.items()
    )
    advice = "It breaks splatline when it is installed again or removed: give splatline an environment of its own"
    values = {"owners": {owner: list(names) for owner, names in owners.items()}}
    return Diagnosis("packages", Grade.WARNING, others, "", advice, values)


def frame_rate(worked: DryRun) -> Diagnosis:
    """Frames/s and bytes/s of the scan's blocks against what camera and link give."""
    frame, most = worked.timeline.frame_bytes, 1 / worked.camera.min_period

    def in_hertz(rate: float) -> str:
        return f"{rate:.3g} frames/s = {size(rate * frame)}/s"

    rates = {
        "views" if block.kind is FrameKind.PROJECTION else f"{block.kind.name.lower()}s": 1 / block.period
        for block in worked.timeline.blocks
    }
    fastest = max(rates.values())
    observed = "; ".join(f"{name} {in_hertz(rate)}" for name, rate in rates.items()) + f", frames of {size(frame)}."
    expected = f"at most {in_hertz(most)}, which camera and link give"
    values = {"frames_per_s": fastest, "bytes_per_s": fastest * frame, "most_frames_per_s": most}
    if fastest <= most * (1 + 1e-9):
        return Diagnosis(_RATE, Grade.OK, observed, expected, values=values)
    return Diagnosis(_RATE, Grade.FAILED, observed, expected, "`beamline check` says which limits it breaks", values)


def _monitor(config: BeamMonitorConfig, connected: Sequence[SerialPort], clock: Clock) -> Iterator[Diagnosis]:
    """The beam monitor, if one is configured: its port, and one reading."""
    name = "beam monitor"
    if not isinstance(config, BeamMonitorSection):
        return
    if (at := getattr(config, "port", None)) is not None:
        of_port = port(f"{name} port", at, connected)
        yield of_port
        if of_port.verdict in (Grade.FAILED, Grade.NOT_APPLICABLE):
            return
    try:
        with closing(make_beam_monitor(config, clock)) as monitor:
            reading = monitor.reading()
    except DeviceError as error:
        yield of_error(name, error, "a reading")
        return
    values = {"value": reading.value, "unit": reading.unit}
    yield Diagnosis(name, Grade.OK, f"{reading.value:.6g} {reading.unit}.", "a reading", values=values)


def _filter(config: FilterConfig, connected: Sequence[SerialPort], clock: Clock) -> Iterator[Diagnosis]:
    """A filter that is not moved by hand: its port, or the place at which it stands."""
    name, expected = "filter", f"one of its places: {', '.join(config.places)}"
    if isinstance(config, MotorFilter):
        yield port(f"{name} port", config.stage.port, connected)
    if not isinstance(config, FoundFilter):
        return
    try:
        with closing(config.connect(clock)) as device:
            place = device.place()
    except DeviceError as error:
        yield of_error(name, error, expected)
        return
    if place is None:
        advice = "Compare devices.filter.places with the values of status_pv; a scan that names its place moves it"
        yield Diagnosis(name, Grade.WARNING, "It stands at no place that has a name.", expected, advice)
    else:
        yield Diagnosis(name, Grade.OK, f"{place}.", expected, values={"place": place})


def _monochromator(config: MonochromatorConfig, clock: Clock) -> Iterator[Diagnosis]:
    """A monochromator with a connection of its own: the energy at which it stands."""
    name, expected = "monochromator", "an energy"
    if not isinstance(config, FoundMonochromator):
        return
    try:
        with closing(config.connect(clock)) as connected:
            energy = connected.energy()
    except DeviceError as error:
        yield of_error(name, error, expected)
        return
    low, high = config.range_kev or (0.0, math.inf)
    if energy > 0 and low <= energy <= high:
        yield Diagnosis(name, Grade.OK, f"{energy:.7g} keV.", expected, values={"energy_kev": energy})
    else:
        advice = "Compare devices.monochromator.unit and range_kev with what status_pv shows"
        legal = f"{expected} above 0 keV" if config.range_kev is None else f"{expected} of {low:g} to {high:g} keV"
        yield Diagnosis(name, Grade.WARNING, f"It stands at {energy:.7g} keV.", legal, advice)


def memory(free: int | None, needs: ScanNeeds | None) -> Diagnosis:
    """Free memory against a scan's need. `free`: bytes; None if the system does not report them."""
    expected, values = "", {"free_bytes": free}
    if needs is not None:
        parts = [f"{size(needs.waiting_bytes)} for frames that wait for the disk"]
        if needs.ring_bytes:
            parts.append(f"{size(needs.ring_bytes)} for the camera's ring")
        expected = " and ".join(parts) + ", besides the live reconstruction"
        values |= {"needed_bytes": needs.memory, "ring_bytes": needs.ring_bytes}
    if free is None:
        return Diagnosis(_MEMORY, Grade.CANNOT_CHECK, "This system does not report its free memory.", expected)
    observed = f"{size(free)} free."
    if needs is None or free >= 2 * needs.memory:
        return Diagnosis(_MEMORY, Grade.OK, observed, expected, values=values)
    advice = "Close other programs, or choose a smaller roi or binning"
    return Diagnosis(
        _MEMORY, Grade.WARNING if free >= needs.memory else Grade.FAILED, observed, expected, advice, values
    )
