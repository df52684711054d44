"""The doctor on disk and memory: verdicts against a closed form of the need, and a file that always goes away."""

from __future__ import annotations

import errno
import io
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamline.features.doctor import examine as disk
from beamline.features.doctor.check import Grade
from beamline.features.doctor.examine import ScanNeeds, memory
from drivers.base.clock import SystemClock
from simulators.devices.clock import VirtualClock

MB, GB = 1_000_000, 1_000_000_000


def need(rate: float, seconds: float = 100.0, waiting: int = GB) -> ScanNeeds:
    size = round(rate * seconds)
    return ScanNeeds(stretches=((size, seconds),), waiting_bytes=waiting, ring_bytes=2 * GB, file_bytes=size)


class Slow(io.BytesIO):
    """A file on a disk of `rate` bytes/s, on a virtual clock; it keeps no bytes."""

    def __init__(self, clock: VirtualClock, rate: float, fails_at: int | None = None) -> None:
        super().__init__()
        self._clock, self._rate, self._fails_at, self.written = clock, rate, fails_at, 0

    def write(self, data: Any) -> int:
        taken = min(len(data), 5_000_000)  # an unbuffered file may take less than it is given
        self.written += taken
        if self._fails_at is not None and self.written > self._fails_at:
            raise OSError(errno.ENOSPC, "No space left on device")
        self._clock.sleep(taken / self._rate)
        return taken

    def fileno(self) -> int:
        return -1


@pytest.fixture
def synced(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How often the disk was waited for."""
    calls: list[int] = []
    monkeypatch.setattr(os, "fsync", calls.append)
    return calls


@pytest.fixture
def room(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    def has(free: int) -> None:
        monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=free))

    has(1000 * GB)
    return has


@pytest.mark.parametrize("rate", [2 * MB, 150 * MB, 3 * GB])
def test_the_rate_is_the_disk_s(synced: list[int], rate: float, tmp_path: Path) -> None:
    clock = VirtualClock()
    measured = disk.measure(tmp_path, clock, lambda folder: Slow(clock, rate))
    assert measured.rate == pytest.approx(rate, rel=1e-3)
    assert len(synced) == measured.n_bytes // disk.PIECE >= 4
    # It ends after some seconds, or after some gigabytes, and never without enough to tell.
    longest = max(disk.SECONDS + disk.PIECE / rate, disk.LEAST / rate)
    assert measured.seconds <= longest * 1.001
    assert disk.LEAST <= measured.n_bytes <= disk.MOST


@pytest.mark.parametrize(
    ("rate", "verdict"),
    [
        (130 * MB, Grade.OK),
        (120 * MB, Grade.WARNING),  # faster than the need, by little
        (97 * MB, Grade.WARNING),  # 300 MB wait at the end, of 1 GB
        (80 * MB, Grade.FAILED),  # 2 GB would have to wait
    ],
)
def test_the_verdict_is_what_would_have_to_wait(
    synced: list[int], room: object, tmp_path: Path, rate: float, verdict: Grade
) -> None:
    clock = VirtualClock()
    check = disk.speed(tmp_path, need(100 * MB), clock, lambda folder: Slow(clock, rate))
    assert check.verdict is verdict
    assert check.expected == "100 MB/s, with previews, at the highest frame rate"
    assert check.values["backlog"] == pytest.approx(max(0, (100 * MB - rate) * 100), rel=0.01, abs=MB)
    assert (check.advice == "") == (verdict is Grade.OK)


@given(st.lists(st.tuples(st.integers(1, 10**9), st.floats(0.1, 100)), min_size=1), st.floats(1e3, 1e9))
def test_backlog_against_small_steps(stretches: list[tuple[int, float]], rate: float) -> None:
    """Bytes that come evenly and leave evenly, in 50 steps a stretch."""
    needs = ScanNeeds(tuple(stretches), 0, 0, 0)
    waiting = most = 0.0
    for size, seconds in stretches:
        for _ in range(50):
            waiting = max(0.0, waiting + size / 50 - rate * seconds / 50)
            most = max(most, waiting)
    assert needs.backlog(rate) == pytest.approx(most, rel=1e-6, abs=1.0)


def test_a_real_folder_is_left_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(disk, "MOST", disk.LEAST)
    (tmp_path / "scan.h5").write_bytes(b"precious")
    check = disk.speed(tmp_path / "runs" / "today", None, SystemClock())  # not there yet, and not made
    assert check.verdict is Grade.OK
    assert check.values["written"] == disk.LEAST
    assert [path.name for path in tmp_path.iterdir()] == ["scan.h5"]
    assert (tmp_path / "scan.h5").read_bytes() == b"precious"


def test_a_disk_that_fills_up_or_refuses(synced: list[int], room: object, tmp_path: Path) -> None:
    clock = VirtualClock()
    check = disk.speed(tmp_path, None, clock, lambda folder: Slow(clock, GB, fails_at=20 * MB))
    assert check.verdict is Grade.FAILED
    assert "No space left" in check.observed

    def refuses(folder: Path) -> IO[bytes]:
        raise PermissionError(errno.EACCES, "Permission denied")

    check = disk.speed(tmp_path, need(MB), clock, refuses)
    assert check.verdict is Grade.FAILED
    assert "Permission denied" in check.observed and "storage.folder" in check.advice


def test_a_disk_without_room_is_not_filled(room: Callable[[int], None], tmp_path: Path) -> None:
    room(100 * MB)

    def untouched(folder: Path) -> IO[bytes]:
        raise AssertionError("it was written to")

    assert disk.speed(tmp_path, None, VirtualClock(), untouched).verdict is Grade.CANNOT_CHECK


@pytest.mark.parametrize(("free", "verdict"), [(25, Grade.OK), (15, Grade.WARNING), (9, Grade.FAILED)])
def test_room(room: Callable[[int], None], tmp_path: Path, free: int, verdict: Grade) -> None:
    room(free * GB)
    assert disk.room(tmp_path / "runs", need(100 * MB)).verdict is verdict
    assert disk.room(tmp_path, None).verdict is Grade.OK


@pytest.mark.parametrize(
    ("free", "verdict"),
    [(7 * GB, Grade.OK), (4 * GB, Grade.WARNING), (2 * GB, Grade.FAILED), (None, Grade.CANNOT_CHECK)],
)
def test_memory(free: int | None, verdict: Grade) -> None:
    check = memory(free, need(100 * MB))  # 1 GB of waiting frames and 2 GB of ring
    assert check.verdict is verdict
    assert "1 GB for frames that wait for the disk and 2 GB for the camera's ring" in check.expected
