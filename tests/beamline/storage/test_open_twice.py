"""A scan opened twice in one program is read as written, while it grows and afterwards (HDF5 shares it)."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline import api
from beamline.monitor.digest import digest
from beamline.storage.readers.open import ScanSource, open_scan
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from drivers.base.clock import SystemClock
from drivers.base.frame import Frame, FrameKind

N, FIRST = 600, 100  # rows: more than a chunk of 512
COUNTS = np.arange(8, dtype=np.uint16).reshape(2, 4)


@contextmanager
def writer(path: Path) -> Iterator[NXtomoWriter]:
    with NXtomoWriter(path, ScanInfo("s"), COUNTS.shape, clock=SystemClock(), flush_every=100) as writer:
        append(writer, FIRST)
        yield writer
        append(writer, N - FIRST)


def append(writer: NXtomoWriter, n: int) -> None:
    for i in range(writer.rows, writer.rows + n):
        writer.append(Frame(COUNTS, FrameKind.PROJECTION, i, i, i, 0.001 * i, 1e9 + i, 0.05), digest(COUNTS))


def is_as_written(source: ScanSource, n: int) -> bool:
    triggers = [frame.trigger for frame in source.frames()]
    angles = np.allclose(source.table.angles, 0.001 * np.arange(n))
    return source.refresh() == n and not source.table.altered.any() and angles and triggers == [*range(n)]


def other_program(path: Path) -> subprocess.Popen[str]:
    """Writes the scan: FIRST frames, and the others after a line on its stdin."""
    code = f"from {__name__} import *\nwith writer(Path({str(path)!r})): print('half', flush=True), input()"
    process = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "half\n"
    return process


@pytest.mark.slow
def test_followed_twice_and_looked_at_while_another_program_writes(tmp_path: Path) -> None:
    path = tmp_path / "scan.h5"
    with other_program(path) as process, open_scan(path, follow=True) as one, open_scan(path, follow=True) as two:
        for n in (FIRST, N):
            for source in (one, two):
                source.refresh()
                assert is_as_written(source, n)
            with open_scan(path) as looked_at:
                assert is_as_written(looked_at, n)
            process.communicate("\n" if n < N else None)
        assert one.finished and two.finished and two.attributes["status"] == "complete"
        assert is_as_written(one, N)


def test_read_in_the_program_that_writes_it(tmp_path: Path) -> None:
    """Also beyond its end: what the reader gives back changes nothing in the file."""
    path = tmp_path / "scan.h5"
    with writer(path) as writing:
        frames = api.stream(path)
        assert [next(frames).trigger for _ in range(FIRST)] == [*range(FIRST)]
        source = open_scan(path, follow=True)
    assert writing.remarks == []
    assert [frame.trigger for frame in frames] == [*range(FIRST, N)]
    source.refresh()
    assert is_as_written(source, N)
    content = path.read_bytes()
    source.close()
    assert path.read_bytes() == content
    with h5py.File(path) as file:
        assert len(file["exchange/data"]) == N


def test_a_file_open_by_h5py_itself_keeps_its_frames_and_gets_no_view(tmp_path: Path) -> None:
    path = tmp_path / "scan.h5"
    with writer(path) as writing:
        mine = h5py.File(path, "r", swmr=True)
    mine.close()
    assert "open with h5py" in writing.remarks[0]
    with open_scan(path) as source:
        assert is_as_written(source, N)
