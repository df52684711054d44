"""in_parts: the parts of a growing scan equal the file that joins them at the end."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.monitor.check import Flag, Level
from beamline.monitor.checks import CHECKS
from beamline.monitor.digest import digest
from beamline.storage.frame_table import FrameTable
from beamline.storage.parts import join
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.rules.evidence import ScanEvidence
from beamline.storage.rules.scan import parts_joined
from beamline.storage.writers import layout
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from drivers.base.clock import SystemClock
from drivers.base.frame import Frame
from tests.beamline.scans import TwoCylinders, frames_of

SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 20.0)))
PLAN = {"angles_deg": [0.0] * 9, **{kind: {"count": 2, "at": "start"} for kind in ("darks", "flats")}}


def _writer(path: Path, shape: tuple[int, int] = SCAN.shape) -> NXtomoWriter:
    return NXtomoWriter(path, ScanInfo("sample", plan=json.dumps(PLAN)), shape, clock=SystemClock())


def _append(writer: NXtomoWriter, frames: list[Frame], replaces: int = -1) -> None:
    """The last one has a warning, and replaces a row."""
    for frame in frames:
        i, last = writer.rows, frame is frames[-1]
        row = Frame(**{**vars(frame), "index": i, "replaces": replaces if last else -1})
        writer.append(row, digest(frame.counts), [Flag(CHECKS[1].name, Level.WARN, i, 1.0, 0.0, "")] if last else [])


def test_it_is_the_joined_scan(tmp_path: Path, rng: np.random.Generator) -> None:
    frames, parts = frames_of(SCAN), [tmp_path / name for name in ("one.h5", "two.h5", "three.h5")]
    for path, some in zip(parts, (frames[:7], frames[:9], frames[4:]), strict=True):
        with _writer(path) as writer:
            _append(writer, some, replaces=5)
    join(parts, tmp_path / "joined.h5")
    fields = [name for name in FrameTable.__annotations__ if name != "flags"]
    flags = ("bits", "scores", "regions")
    chosen: tuple[Any, ...] = (slice(None), rng.permutation(25), [24, 3, -1, 8], [])
    with open_scan(tmp_path / "joined.h5") as joined:  # not while the parts are open in another mode
        expected, plan, checksummed = joined.table, joined.plan, joined.checksummed
        flagged, pixels = expected.flags, [joined.read(rows, slice(1, 3)) for rows in chosen]
    with SourceOptions(parts[-1], earlier=tuple(parts[:-1])).open(follow=True) as source:
        assert source.refresh() == 25
        for name in fields:
            np.testing.assert_array_equal(getattr(source.table, name), getattr(expected, name))
        for name in flags:
            np.testing.assert_array_equal(getattr(source.table.flags, name), getattr(flagged, name))
        for rows, seen in zip(chosen, pixels, strict=True):
            np.testing.assert_array_equal(source.read(rows, slice(1, 3)), seen)
        assert (source.finished, source.checksummed, source.plan) == (True, checksummed, plan)
        assert list(parts_joined(ScanEvidence(source))) == []  # it is all of it
    with SourceOptions(parts[-1], earlier=tuple(parts[:-1]), quantity="counts").open() as replaced:
        assert len(replaced.table) == 25


def test_its_last_part_grows(tmp_path: Path) -> None:
    frames = frames_of(SCAN)
    with _writer(tmp_path / "one.h5") as writer:
        _append(writer, frames[:6])
    with _writer(tmp_path / "two.h5") as writer:
        options = SourceOptions(tmp_path / "two.h5", earlier=(tmp_path / "one.h5",))
        with options.open(follow=True) as source:
            assert (len(source.table), source.table.part_starts.tolist(), source.finished) == (6, [0, 6], False)
            _append(writer, frames[6:8])
            assert source.refresh() == 8
            np.testing.assert_array_equal(source.read([7])[0], frames[7].counts)
            flags = source.table.flags
            assert flags is not None and flags.flagged.tolist() == [False] * 5 + [True, False, True]


def test_damaged_frames_are_counted_over_all_parts(tmp_path: Path) -> None:
    for name in ("one.h5", "two.h5"):
        with _writer(tmp_path / name) as writer:
            _append(writer, frames_of(SCAN)[:6])
    with h5py.File(tmp_path / "two.h5", "r+") as file:
        file[layout.DATA][2, 0, 0] ^= 8
    with SourceOptions(tmp_path / "two.h5", earlier=(tmp_path / "one.h5",)).open() as source:
        source.read(slice(None))
        assert source.damaged == {8}


def test_parts_of_other_scans_are_refused(tmp_path: Path) -> None:
    for name, shape in (("one.h5", SCAN.shape), ("two.h5", (8, 8))):
        with _writer(tmp_path / name, shape):
            pass
    with pytest.raises(DataError, match=r"one\.h5 .*\(4, 40\).*of one scan"):
        SourceOptions(tmp_path / "two.h5", earlier=(tmp_path / "one.h5",)).open()
