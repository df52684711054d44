"""Doctor on the disk: measured write speed and free space against the needs of a scan."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Protocol

import numpy as np

from beamline.core.text import size
from beamline.doctor.check import Diagnosis, Grade
from beamline.doctor.needs import ScanNeeds
from beamline.scan.preflight import free_bytes
from drivers.base.clock import Clock

SECONDS, MOST = 3.0, 4 << 30
"""Longest time (s on the clock) and most bytes of a measurement."""
PIECE = 16 << 20
"""Bytes that are written and synchronised together."""
LEAST = 4 * PIECE
"""Fewer bytes give no reliable rate."""
COMFORT = 1.25
"""A disk faster than the need by this factor is good; a slower one may be disturbed by other programs."""
SPEED, ROOM = "disk speed", "disk space"


@dataclass(frozen=True)
class Measured:
    """Bytes written, and the s until they were on the disk."""

    n_bytes: int
    seconds: float

    @property
    def rate(self) -> float:
        return self.n_bytes / max(self.seconds, 1e-9)  # a clock may be coarse


class Opens(Protocol):
    """Opens a new file in a folder; the file is removed when it is closed or the process ends."""

    def __call__(self, folder: Path) -> IO[bytes]: ...


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
    there = existing(folder)
    # The file is temporary, but must not fill the disk even for a moment.
    most = min(MOST, shutil.disk_usage(there).free // 4)
    if most < LEAST:
        return Diagnosis(SPEED, Grade.CANNOT_CHECK, f"{there} has too little free space for a measurement.", expected)
    try:
        measured = measure(there, clock, opens, most)
    except OSError as error:
        if error.errno == errno.EINVAL:  # a file system without fsync
            return Diagnosis(
                SPEED, Grade.CANNOT_CHECK, f"{there} does not report when bytes are on the disk.", expected
            )
        return Diagnosis(
            SPEED,
            Grade.FAILED,
            f"{there} cannot be written to ({error.strerror or error}).",
            expected or "a folder in which files can be created",
            "Choose another storage.folder, or correct its permissions or its disk",
        )
    rate = measured.rate
    found = f"{size(rate)}/s at {there} ({size(measured.n_bytes)} in {measured.seconds:.1f} s, synchronised)."
    values = {"bytes_per_s": rate, "written": measured.n_bytes, "seconds": measured.seconds}
    if needs is None:
        return Diagnosis(SPEED, Grade.OK, found, values=values)
    backlog = needs.backlog(rate)
    values |= {"needed_bytes_per_s": needs.rate, "backlog": backlog, "waiting_bytes": needs.waiting_bytes}
    if rate >= COMFORT * needs.rate:
        return Diagnosis(SPEED, Grade.OK, found, expected, values=values)
    if backlog <= needs.waiting_bytes / 2:
        found += f" At most {size(backlog)} will wait in memory, which has room for {size(needs.waiting_bytes)}."
        advice = "Let no other program write to this disk during the scan, or choose a faster disk"
        return Diagnosis(SPEED, Grade.WARNING, found, expected, advice, values)
    found += f" {size(backlog)} would have to wait in memory, which has room for {size(needs.waiting_bytes)}."
    advice = "Choose a storage.folder on a faster disk, or a longer period, a smaller roi or binning"
    return Diagnosis(SPEED, Grade.FAILED, found, expected, advice, values)


def room(folder: Path, needs: ScanNeeds | None) -> Diagnosis:
    """Free space against the size of the file."""
    free = free_bytes(folder)
    found, values = f"{size(free)} free for {folder.absolute()}.", {"free_bytes": free}
    if needs is None:
        return Diagnosis(ROOM, Grade.OK, found, values=values)
    values["needed_bytes"] = needs.file_bytes
    expected = f"{size(needs.file_bytes)} for the scan and a tenth more; as much again for its reconstruction"
    if free < needs.file_bytes:
        advice = "Free some space, choose another storage.folder, or reduce views, roi or binning"
        return Diagnosis(ROOM, Grade.FAILED, found, expected, advice, values)
    if free < 2 * needs.file_bytes:
        return Diagnosis(ROOM, Grade.WARNING, found, expected, "Free some space before the next scan", values)
    return Diagnosis(ROOM, Grade.OK, found, expected, values=values)


def existing(folder: Path) -> Path:
    """The folder, or its nearest parent that exists: a scan creates the folder, the doctor does not."""
    folder = folder.absolute()
    return next((place for place in (folder, *folder.parents) if place.is_dir()), folder)
