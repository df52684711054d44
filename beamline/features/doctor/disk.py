"""Doctor on the disk: what a planned scan needs, and the measured write speed and free space against it."""

from __future__ import annotations

import errno
import math
import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO

import numpy as np

from beamline.core.text import size
from beamline.features.doctor.check import Diagnosis, Grade
from beamline.plan.limits import ROOM as MARGIN
from beamline.scan.preflight import DryRun, disk_of
from beamline.scan.recorder import room as waiting_room
from beamline.storage.writer_lock import no_locks
from drivers.base.clock import Clock

SECONDS, MOST = 3.0, 4 << 30  # Longest time (s on the clock) and most bytes of a measurement
PIECE = 16 << 20  # Bytes that are written and synchronised together
LEAST = 4 * PIECE  # Fewer bytes give no reliable rate
COMFORT = 1.25  # A disk faster than the need by this factor is good; a slower one may be disturbed by other programs
SPEED, ROOM, LOCKS = "disk speed", "disk space", "file locks"


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
        """The largest number of bytes that wait for a disk of `rate` bytes/s."""
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


Opens = Callable[[Path], IO[bytes]]
"""Opens a new file in a folder; the file is removed when it is closed or the process ends."""


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
        if error.errno == errno.EINVAL:  # a file system without fsync
            return diagnosis(Grade.CANNOT_CHECK, f"{there} does not report when bytes are on the disk.")
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
