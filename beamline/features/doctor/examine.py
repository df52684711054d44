"""Runs all checks of the instrument's computer that a configuration needs, one after the other."""

from __future__ import annotations

import math
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np

from beamline.config.beam import BeamMonitorSection, FoundFilter, FoundMonochromator, MotorFilter
from beamline.config.devices import BeamMonitorConfig, DcamOrca, FilterConfig, MonochromatorConfig
from beamline.config.load import Config
from beamline.config.models import StorageSection
from beamline.core.machine import free_memory
from beamline.core.text import size
from beamline.features.doctor import devices
from beamline.features.doctor.check import Diagnosis, Grade, of_error
from beamline.features.doctor.devices import port, ports
from beamline.instrument.connect import make_beam_monitor
from beamline.plan.limits import ROOM as MARGIN
from beamline.scan.backlog import room as waiting_room
from beamline.scan.preflight import DryRun, disk_of, dry_run
from beamline.storage.writer_lock import no_locks
from drivers.base.clock import Clock
from drivers.base.errors import DeviceError
from drivers.serial.line import SerialPort, serial_ports

SECONDS, MOST = 3.0, 4 << 30  # Longest time (s on the clock) and most bytes of a measurement
PIECE = 16 << 20  # Bytes that are written and synchronised together
LEAST = 4 * PIECE  # Fewer bytes give no reliable rate
COMFORT = 1.25  # A disk faster than the need by this factor is good; a slower one may be disturbed by other programs
SPEED, ROOM, LOCKS = "disk speed", "disk space", "file locks"
Opens = Callable[[Path], IO[bytes]]
"""Opens a new file in a folder; the file is removed when it is closed or the process ends."""
_MEMORY = "memory"


@dataclass(frozen=True)
class ScanNeeds:
    """The disk and memory that a scan needs."""

    stretches: tuple[tuple[int, float], ...]  # (bytes to write, duration in s) of each block
    waiting_bytes: int  # memory for frames that wait for the disk
    ring_bytes: int  # memory of the camera's ring; 0 for a simulated one
    file_bytes: int  # size of the file and the margin that a scan needs beside it

    @property
    def rate(self) -> float:
        """Bytes/s at the highest frame rate."""
        return max(n_bytes / seconds for n_bytes, seconds in self.stretches)

    @property
    def memory(self) -> int:
        return self.waiting_bytes + self.ring_bytes

    def backlog(self, rate: float) -> float:
        """Most bytes that ever wait for a disk that writes `rate` bytes/s."""
        most = waiting = 0.0
        for n_bytes, seconds in self.stretches:
            waiting = max(waiting + n_bytes - rate * seconds, 0.0)
            most = max(most, waiting)
        return most


def needs(worked: DryRun, most_ring: int) -> ScanNeeds:
    """The needs of a planned scan; `most_ring`: bytes that the camera's ring may take, 0 without one.

    The ring holds the longest block, with one slot more than frames and at least 16, like the driver.
    """
    timeline = worked.timeline
    slots = max(max(block.n for block in timeline.blocks) + 1, 16)
    per_row = timeline.total_bytes // timeline.n_frames
    return ScanNeeds(
        stretches=tuple((block.n * per_row, block.n * block.period) for block in timeline.blocks),
        waiting_bytes=waiting_room(timeline) * timeline.frame_bytes,
        ring_bytes=max(2, min(slots, most_ring // timeline.frame_bytes)) * timeline.frame_bytes if most_ring else 0,
        file_bytes=math.ceil(worked.total_bytes * MARGIN),
    )


@dataclass(frozen=True)
class Measured:
    """Bytes written, and the s until they were on the disk."""

    n_bytes: int
    seconds: float

    @property
    def rate(self) -> float:
        return self.n_bytes / max(self.seconds, 1e-9)  # a clock may be coarse


def temporary(folder: Path) -> IO[bytes]:
    """A new file without a name, or one that the system removes: nothing is overwritten or left behind."""
    return tempfile.TemporaryFile(dir=folder, prefix="beamline-doctor-", buffering=0)


def measure(
    folder: Path, clock: Clock, opens: Opens = temporary, most: int = MOST, seconds: float = SECONDS
) -> Measured:
    """Write incompressible bytes to a temporary file in `folder`, synchronised after each piece.

    Raises:
        OSError: the folder cannot be written to, or the disk is full.
    """
    piece = memoryview(np.random.default_rng().bytes(PIECE))
    written = 0
    with opens(folder) as file:
        began = clock.now()
        while written + PIECE <= most and (written < LEAST or clock.now() - began < seconds):
            at = 0
            while at < PIECE:
                at += file.write(piece[at:])
            os.fsync(file.fileno())
            written += PIECE
        return Measured(written, clock.now() - began)


def speed(folder: Path, needs: ScanNeeds | None, clock: Clock, opens: Opens = temporary) -> Diagnosis:
    """Write speed of the disk that holds `folder`, or will hold it, against the rate of the frames."""
    expected = "" if needs is None else f"{size(needs.rate)}/s, with previews, at the highest frame rate"
    there, diagnosis = disk_of(folder), partial(Diagnosis, SPEED, expected=expected)
    # The file is temporary, but must not fill the disk even for a moment.
    most = min(MOST, shutil.disk_usage(there).free // 4)
    if most < LEAST:
        return diagnosis(Grade.CANNOT_CHECK, f"{there} has too little free space for a measurement.")
    try:
        measured = measure(there, clock, opens, most)
    except OSError as error:
        expected = expected or "a folder in which files can be created"
        advice = "Choose another storage.folder, or correct its permissions or its disk"
        observed = f"{there} cannot be written to ({error.strerror or error})."
        return Diagnosis(SPEED, Grade.FAILED, observed, expected, advice)
    rate = measured.rate
    observed = f"{size(rate)}/s at {there} ({size(measured.n_bytes)} in {measured.seconds:.1f} s, synchronised)."
    values = {"bytes_per_s": rate, "written": measured.n_bytes, "seconds": measured.seconds}
    if needs is None:
        return diagnosis(Grade.OK, observed, values=values)
    backlog, there_is_room = needs.backlog(rate), f"in memory, which has room for {size(needs.waiting_bytes)}."
    values |= {"needed_bytes_per_s": needs.rate, "backlog": backlog, "waiting_bytes": needs.waiting_bytes}
    if rate >= COMFORT * needs.rate:
        return diagnosis(Grade.OK, observed, values=values)
    if backlog <= needs.waiting_bytes / 2:
        observed += f" At most {size(backlog)} will wait {there_is_room}"
        advice = "Let no other program write to this disk during the scan, or choose a faster disk"
        return diagnosis(Grade.WARNING, observed, advice=advice, values=values)
    observed += f" {size(backlog)} would have to wait {there_is_room}"
    advice = "Choose a storage.folder on a faster disk, or a longer period, a smaller roi or binning"
    return diagnosis(Grade.FAILED, observed, advice=advice, values=values)


def locks(folder: Path) -> Diagnosis:
    """Whether files can be locked where the scan's file will be, as HDF5 wants."""
    there = disk_of(folder)
    if no_locking := no_locks(there):
        cause, _, advice = no_locking.partition("; ")
        return Diagnosis(LOCKS, Grade.FAILED, f"{cause[0].upper()}{cause[1:]}.", "a disk with file locks", advice)
    return Diagnosis(LOCKS, Grade.OK, f"Files in {there} can be locked.")


def room(folder: Path, needs: ScanNeeds | None) -> Diagnosis:
    """Free space against the size of the file."""
    free = shutil.disk_usage(disk_of(folder)).free
    observed, values = f"{size(free)} free for {folder.absolute()}.", {"free_bytes": free}
    if needs is None:
        return Diagnosis(ROOM, Grade.OK, observed, values=values)
    values["needed_bytes"] = needs.file_bytes
    expected = f"{size(needs.file_bytes)} for the scan and a tenth more; as much again for its reconstruction"
    if free < needs.file_bytes:
        advice = "Free some space, choose another storage.folder, or reduce views, roi or binning"
        return Diagnosis(ROOM, Grade.FAILED, observed, expected, advice, values)
    if free < 2 * needs.file_bytes:
        return Diagnosis(ROOM, Grade.WARNING, observed, expected, "Free some space before the next scan", values)
    return Diagnosis(ROOM, Grade.OK, observed, expected, values=values)


def examine(config: Config | None, clock: Clock, *, session: bool = False, usb: Any = None) -> Iterator[Diagnosis]:
    """Check the camera's link and library, ports, disk and memory. Nothing moves and nothing is overwritten.

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
    yield room(folder, need)
    yield locks(folder)
    yield speed(folder, need, clock)
    yield memory(free_memory(), need)


def _read(name: str, expected: str, connect: Callable[[], Any], judge: Callable[[Any], Diagnosis]) -> Diagnosis:
    """What a device says of itself, or why it says nothing."""
    try:
        with closing(connect()) as device:
            return judge(device)
    except DeviceError as error:
        return of_error(name, error, expected)


def _monitor(config: BeamMonitorConfig, connected: Sequence[SerialPort], clock: Clock) -> Iterator[Diagnosis]:
    """The beam monitor, if one is configured: its port, and one reading."""
    name = "beam monitor"
    if not isinstance(config, BeamMonitorSection):
        return
    if (at := getattr(config, "port", None)) is not None:
        yield (of_port := port(f"{name} port", at, connected))
        if of_port.verdict in (Grade.FAILED, Grade.NOT_APPLICABLE):
            return

    def judge(monitor: Any) -> Diagnosis:
        reading = monitor.reading()
        values = {"value": reading.value, "unit": reading.unit}
        return Diagnosis(name, Grade.OK, f"{reading.value:.6g} {reading.unit}.", "a reading", values=values)

    yield _read(name, "a reading", lambda: make_beam_monitor(config, clock), judge)


def _filter(config: FilterConfig, connected: Sequence[SerialPort], clock: Clock) -> Iterator[Diagnosis]:
    """A filter that is not moved by hand: its port, or the place at which it stands."""
    expected = f"one of its places: {', '.join(config.places)}"

    def judge(device: Any) -> Diagnosis:
        if (place := device.place()) is not None:
            return Diagnosis("filter", Grade.OK, f"{place}.", expected, values={"place": place})
        advice = "Compare devices.filter.places with the values of status_pv; a scan that names its place moves it"
        return Diagnosis("filter", Grade.WARNING, "It stands at no place that has a name.", expected, advice)

    if isinstance(config, MotorFilter):
        yield port("filter port", config.stage.port, connected)
    if isinstance(config, FoundFilter):
        yield _read("filter", expected, lambda: config.connect(clock), judge)


def _monochromator(config: MonochromatorConfig, clock: Clock) -> Iterator[Diagnosis]:
    """The energy at which a monochromator with its own connection stands."""
    if not isinstance(config, FoundMonochromator):
        return
    low, high = config.range_kev or (0.0, math.inf)

    def judge(connected: Any) -> Diagnosis:
        energy = connected.energy()
        legal, values = f"an energy above 0 and from {low:g} to {high:g} keV", {"energy_kev": energy}
        if energy > 0 and low <= energy <= high:
            return Diagnosis("monochromator", Grade.OK, f"{energy:.7g} keV.", legal, values=values)
        advice = "Compare devices.monochromator.unit and range_kev with what status_pv shows"
        return Diagnosis("monochromator", Grade.WARNING, f"It stands at {energy:.7g} keV.", legal, advice)

    yield _read("monochromator", "an energy", lambda: config.connect(clock), judge)


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
