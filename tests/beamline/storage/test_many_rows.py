"""Columns of more rows than a chunk are read as they were written, at once and while the file grows."""

from pathlib import Path

import numpy as np

from beamline.monitor.digest import digest
from beamline.storage.readers.open import open_scan
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from drivers.base.clock import SystemClock
from drivers.base.frame import Frame, FrameKind

N = 1100  # two chunks and a bit
COUNTS = np.arange(8, dtype=np.uint16).reshape(2, 4)


def frame(i: int) -> Frame:
    return Frame(COUNTS, FrameKind.PROJECTION, i, i, i, 0.001 * i, 1e9 + i, 0.05)


def test_all_rows_are_read_as_written_also_while_the_file_grows(tmp_path: Path) -> None:
    path, statistics = tmp_path / "scan.h5", digest(COUNTS)
    with (
        NXtomoWriter(path, ScanInfo("s"), COUNTS.shape, clock=SystemClock(), flush_every=100) as writer,
        open_scan(path, follow=True) as growing,
    ):
        for i in range(N):
            writer.append(frame(i), statistics)
            if i % 250 == 249:
                growing.refresh()
                assert not growing.altered
                np.testing.assert_allclose(growing.angles, 0.001 * np.arange(len(growing.angles)))
    with open_scan(path) as source:
        assert not source.altered
        triggers = [found.trigger for found in source.frames()]
        np.testing.assert_allclose(source.angles, 0.001 * np.arange(N))
    assert triggers == list(range(N))
