"""Files that another program still writes (SWMR): followed frame by frame, finished when closed, and said to be
written."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.features.files.validate import describe, validate
from beamline.projections.replayed_frames import growing
from beamline.storage.interrupted import next_step
from beamline.storage.readers.base import ScanSource
from beamline.storage.readers.open import NotReadyError, open_scan
from beamline.storage.superblock import marked_as_being_written
from drivers.base.frame import FrameKind
from tests.beamline.storage.readers.foreign_scans import FRAMES, KEY, VIEWS
from tests.clock import SteppedClock

ANGLES = np.r_[0, 0, np.arange(VIEWS) * 36.0]
N, SHAPE = len(KEY), FRAMES.shape[1:]


class Writer:
    """A program that writes a scan: `room` frames are made room for at the begin, the others as they come."""

    def __init__(self, path: Path, layout: str, room: int = 0) -> None:
        self.file, self.n, self.exchange = h5py.File(path, "w", libver="latest"), 0, layout == "exchange"
        if self.exchange:
            places = {"exchange/data": SHAPE, "exchange/theta": ()}
            self.file["exchange/data_dark"], self.file["exchange/data_white"] = FRAMES[:1], FRAMES[1:2]
            self.values, angle = [FRAMES[2:], ANGLES[2:]], "exchange/theta"
        else:
            detector, angle = "entry/instrument/camera", "entry/sample/rotation_angle"
            places = {f"{detector}/data": SHAPE, angle: (), f"{detector}/image_key": ()}
            self.values = [FRAMES, ANGLES, KEY]
        self.items = [
            self.file.create_dataset(
                where, (room, *shape), values.dtype, maxshape=(None, *shape), chunks=(1, *shape) if shape else (16,)
            )
            for (where, shape), values in zip(places.items(), self.values, strict=True)
        ]
        self.file[angle].attrs["units"] = "deg"
        self.file.swmr_mode = True

    def write(self, n: int, *, only_frames: bool = False) -> None:
        for item, values in list(zip(self.items, self.values, strict=True))[: 1 if only_frames else None]:
            if len(item) < n:
                item.resize(n, 0)
            item[:n] = values[:n]
            item.flush()


@pytest.fixture(params=["nxtomo", "exchange"])
def writer(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Writer]:
    made = Writer(tmp_path / "scan.h5", request.param)
    yield made
    made.file.close()


def known(source: ScanSource, references: int) -> None:
    """All frames of the source are those that were written, with their kinds and angles."""
    n = source.refresh()
    np.testing.assert_array_equal(source.read(slice(None)), FRAMES[:n])
    np.testing.assert_array_equal(source.table.kinds, KEY[:n])
    np.testing.assert_allclose(np.degrees(source.table.angles[references:]), ANGLES[references:n])


def test_frames_are_there_with_their_angles_and_the_file_is_finished_when_it_is_closed(
    tmp_path: Path, writer: Writer
) -> None:
    own = 0 if writer.exchange else 2  # references among the frames that are counted here
    writer.write(own + 2)
    with open_scan(tmp_path / "scan.h5", follow=True) as source:
        known(source, 2)
        assert not source.finished and len(source.table) == 4
        writer.write(own + 4, only_frames=True)  # their angles are still in the writer's memory
        assert source.refresh() == 4
        writer.write(own + 4)
        assert source.refresh() == 6
        known(source, 2)
        writer.write(own + VIEWS)
        writer.file.close()
        assert source.finished
        assert source.refresh() == N
        known(source, 2)


def test_room_for_frames_is_no_frame(tmp_path: Path) -> None:
    writer = Writer(tmp_path / "scan.h5", "nxtomo", room=N)
    writer.items[2][:] = KEY
    for n in (0, 4, 5):
        for item, values in zip(writer.items[:2], writer.values, strict=False):
            item[:n] = values[:n]
            item.flush()
        with open_scan(tmp_path / "scan.h5", follow=True) as source:
            assert len(source.table) == n
    writer.file.close()


def test_flats_that_come_after_the_views_are_numbered_after_them(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "scan.h5", "w", libver="latest") as file:
        makes: Any = {"chunks": (1, *SHAPE), "maxshape": (None, *SHAPE)}
        file["exchange/data"] = FRAMES[2:4]
        white = file.create_dataset("exchange/data_white", data=FRAMES[1:2], **makes)
        file["exchange/theta"] = [0.0, 36]
        file.swmr_mode = True
        with open_scan(tmp_path / "scan.h5", follow=True) as source:
            assert source.table.kinds.tolist() == [FrameKind.FLAT, 0, 0]
            white.resize(3, 0)
            white[1:] = FRAMES[5:7]
            white.flush()
            assert source.refresh() == 5 and source.table.kinds.tolist() == [1, 0, 0, 1, 1]
            np.testing.assert_array_equal(source.read(slice(None)), FRAMES[[1, 2, 3, 5, 6]])


def test_who_does_not_follow_is_told_that_it_is_written_or_that_its_writer_has_died(
    tmp_path: Path, writer: Writer
) -> None:
    path = tmp_path / "scan.h5"
    writer.write(N if not writer.exchange else VIEWS)
    assert "Another program is still writing the scan file: `beamline recon" in next_step(path)
    (found,) = [each.message for each in validate(path) if each.rule == "unfinished"]
    facts = describe(path)
    assert found in facts["findings"] and not facts["finished"] and facts["attributes"]["status"] == "running"
    os.utime(path, (0, 0))
    assert marked_as_being_written(path) and f"h5clear -s {path}" in next_step(path)
    assert describe(path)["attributes"]["status"] == "died"
    writer.file.close()
    assert next_step(path) == "" and describe(path)["finished"]


def test_a_writer_that_died_is_not_awaited_for_ever(tmp_path: Path, writer: Writer) -> None:
    writer.write(4)
    clock = SteppedClock()
    with open_scan(tmp_path / "scan.h5", follow=True) as source, pytest.raises(DataError, match="not grown for 120 s"):
        for _ in growing(source, clock, poll=5.0):
            pass
    assert 120 < clock.now() < 140


def test_a_file_without_a_frame_is_not_ready(tmp_path: Path) -> None:
    writer = Writer(tmp_path / "scan.h5", "exchange")
    with pytest.raises(NotReadyError, match="no projections"):
        open_scan(tmp_path / "scan.h5", follow=True)
    writer.file.close()
