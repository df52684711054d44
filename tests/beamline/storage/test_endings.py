"""Every copy of a scan states how the scan ended, as the scan itself does; otherwise there is an error."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

from beamline.core.errors import DataError
from beamline.features.files.ingest import ingest
from beamline.monitor.digest import digest
from beamline.storage.parts import join
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.recover import recover
from beamline.storage.rules.evidence import ScanEvidence
from beamline.storage.rules.scan import scan_ended
from beamline.storage.writer_lock import QUIET
from beamline.storage.writers.nxtomo import NXtomoWriter
from beamline.storage.writers.rows import DIED, ScanEnding
from drivers.base.frame import Frame
from tests.beamline.storage.conftest import INFO, SHAPE
from tests.clock import SteppedClock

VIEWS = 9
REFERENCES = {"darks": {"count": 2, "at": "start"}, "flats": {"count": 3, "at": "start"}}
PLAN = json.dumps({"angles_deg": np.linspace(0, 180, VIEWS).tolist(), **REFERENCES})
LOST = 5 + 2  # the trigger of a view without a frame
ENDINGS = {
    "complete": ScanEnding(),
    "failed": ScanEnding("failed", (LOST, 13), "The camera does not answer for 2 µs."),
    "killed": ScanEnding("failed", (LOST,), DIED),
}


def _in_place(scan: Path, out: Path) -> None:
    shutil.copy2(scan, out)
    recover(out)


COPIES: dict[str, Callable[[Path, Path], object]] = {
    "ingest": ingest,
    "ingest some columns": lambda scan, out: ingest(SourceOptions(scan, cols=(2, 14)), out),
    "join": lambda scan, out: join([scan], out),
    "recover": _in_place,
}
REFUSED = {("join", "killed")}


@pytest.fixture
def scan(tmp_path: Path, frames: list[Frame], clock: SteppedClock) -> Iterator[Callable[[str], Path]]:
    """A scan that ended so, and lacks a view unless it is complete."""
    with ExitStack() as running:

        def write(end: str) -> Path:
            taken = [frame for frame in frames if end == "complete" or frame.index != LOST][
                : 14 if end == "complete" else 9
            ]
            writer = NXtomoWriter(tmp_path / "scan.h5", replace(INFO, plan=PLAN), SHAPE, clock=clock)
            running.callback(writer.close)
            for row, frame in enumerate(taken):
                writer.append(replace(frame, index=row), digest(frame.counts))
            if end == "killed":
                shutil.copy(writer.path, tmp_path / "died.h5")
                os.utime(tmp_path / "died.h5", (0, (tmp_path / "died.h5").stat().st_mtime - 2 * QUIET))
                return tmp_path / "died.h5"
            if end != "running":
                ending = ENDINGS[end]
                writer.close(ending.status, ending.missing, reason=ending.reason)
            return writer.path

        yield write


def test_numbers_that_a_series_of_files_leaves_out_are_missing_in_its_copy(tmp_path: Path) -> None:
    folder = tmp_path / "series"
    folder.mkdir()
    for name in ("dark_0001", "flat_0001", "view_0003", "view_0004", "view_0006"):
        tifffile.imwrite(folder / f"{name}.tif", np.full(SHAPE, 7, np.uint16))
    ingest(SourceOptions(folder, angles=np.array([0.0, 0.1, 0.3])), tmp_path / "copy.h5")
    with open_scan(tmp_path / "copy.h5") as source:
        assert source.ending == ScanEnding(missing=(4,))


@pytest.mark.parametrize(
    ("command", "end"),
    [
        ("ingest some columns", "failed"),
        *((command, end) for command in ("ingest", "join", "recover") for end in (*ENDINGS, "running")),
    ],
)
def test_a_copy_states_how_its_scan_ended(scan: Callable[[str], Path], tmp_path: Path, command: str, end: str) -> None:
    original, out = scan(end), tmp_path / "copy.h5"
    if end == "running" or (command, end) in REFUSED:
        with pytest.raises(DataError, match=r"written|closed|open in a program"):
            recover(original) if command == "recover" else COPIES[command](original, out)
        assert not out.exists()
        return
    COPIES[command](original, out)
    with open_scan(out) as source:
        assert (source.ending, source.finished) == (ENDINGS[end], True)
        warned = [
            found.message for found in scan_ended(ScanEvidence(source))
        ]  # as validate, recon and its volume say it
    assert (ENDINGS[end].reason in "".join(warned)) and bool(warned) == (end != "complete")
    assert all(f"with 4 of {VIEWS} projections" in message for message in warned)
    if end != "failed":  # which states the most
        return
    again = tmp_path / "again.h5"
    ingest(out, again)
    with open_scan(again) as source:
        assert source.ending == ENDINGS[end]
