"""`beamline publish`: clients see each frame of a run once and in order; their requests, and errors."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from beamline.core.errors import ConfigError, DataError
from beamline.monitor.digest import digest
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from drivers.base.clock import SystemClock
from drivers.base.frame import Frame, FrameKind
from splatline_areadetector.publish_detector import PublishedDetector, Sides, Value, records
from splatline_areadetector.publish_file import FrameFile
from splatline_areadetector.publish_frames import PublishedFrame, RunFrames, SendRate
from splatline_areadetector.publish_servers import ImageServer, RecordServer
from tests.beamline.cli.small_scan import beamline
from tests.beamline.scans import TwoCylinders, frames_of

SCAN = frames_of(TwoCylinders())
FRAME = PublishedFrame(np.arange(12, dtype=np.uint16).reshape(3, 4), 7, FrameKind.PROJECTION, 31.5, 1.7e9 + 0.25, 0.05)


class Clock:
    """s, which stand still."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def _written(folder: Path) -> NXtomoWriter:
    """The scan file of a run that has just begun."""
    folder.mkdir(parents=True)
    (folder / "events.jsonl").write_text('{"event": "run_started"}\n', encoding="utf-8")
    return NXtomoWriter(folder / "scan.h5", ScanInfo("s"), SCAN[0].counts.shape, clock=SystemClock())


def _append(writer: NXtomoWriter, *frames: Frame) -> None:
    for frame in frames:
        row = writer.rows
        writer.append(replace(frame, index=row), digest(frame.counts))


def _come(frames: RunFrames, clock: Clock, within: float = 20.0) -> list[PublishedFrame]:
    """All frames that come while the clock goes on by so many s."""
    come, end = list[PublishedFrame](), clock.now + within
    while clock.now < end:
        if (frame := frames.next()) is not None:
            come.append(frame)
        else:
            clock.now += 0.05
    return come


def test_frames_that_came_together_are_spread_but_keep_up() -> None:
    """A client's queue holds four by default: nine at once, ten a second, are sent no closer than 0.07 s."""
    pace, now, sent, waiting = SendRate(), 0.0, list[float](), 0
    for step in range(3000):
        now = step * 0.01
        if step % 90 == 0:
            pace.came(9, now)
            waiting += 9
        if waiting and not pace.wait(now):
            pace.sent(now)
            sent.append(now)
            waiting -= 1
    assert waiting <= 9 and len(sent) >= 290
    assert min(np.diff(sent[20:])) >= 0.06


def test_the_first_frame_after_a_pause_is_sent_at_once() -> None:
    pace = SendRate()
    pace.came(1, 0.0)
    pace.sent(0.0)
    pace.came(1, 30.0)
    assert pace.wait(30.0) == 0.0


def test_each_frame_of_a_growing_run_comes_once_in_order_and_to_the_bit(tmp_path: Path) -> None:
    clock = Clock()
    with closing(RunFrames(tmp_path, print, clock)) as frames:
        assert frames.next() is None and frames.run is None
        with _written(tmp_path / "2026-01-01T000000_a") as writer:
            come = list[PublishedFrame]()
            for part in (SCAN[:1], SCAN[1:7], SCAN[7:20]):
                _append(writer, *part)
                come += _come(frames, clock)
        assert frames.shape == SCAN[0].counts.shape
        degrees = h5py.File(tmp_path / "2026-01-01T000000_a" / "scan.h5")["entry/sample/rotation_angle"]
        assert [frame.unique_id for frame in come] == list(range(1, 21))
        for frame, ours in zip(come, SCAN, strict=False):
            np.testing.assert_array_equal(frame.counts, ours.counts)
            np.testing.assert_array_equal(frame.angle, degrees[ours.index])
            assert (frame.kind, frame.time, frame.exposure) == (ours.kind, ours.time, ours.exposure)
        degrees.file.close()


def test_the_next_run_begins_anew_and_an_old_one_is_not_repeated(tmp_path: Path) -> None:
    clock = Clock()
    with _written(tmp_path / "2026-01-01T000000_a") as writer:
        _append(writer, *SCAN[:5])
    with closing(RunFrames(tmp_path, print, clock)) as frames:
        assert [frame.unique_id for frame in _come(frames, clock)] == [5]  # as the value that a server has
        with _written(tmp_path / "2026-01-01T000001_b") as writer:
            _append(writer, *SCAN[:3])
        assert [frame.unique_id for frame in _come(frames, clock)] == [1, 2, 3]
        with _written(tmp_path / "2026-01-01T000001_b" / "part-2") as writer:
            _append(writer, *SCAN[3:5])
        assert [frame.unique_id for frame in _come(frames, clock)] == [1, 2]


def test_a_damaged_file_is_told_and_the_next_run_is_published(tmp_path: Path) -> None:
    clock, told = Clock(), list[str]()
    with _written(tmp_path / "2026-01-01T000000_a") as writer:
        _append(writer, *SCAN[:5])
    with h5py.File(tmp_path / "2026-01-01T000000_a" / "scan.h5", "r+") as file:
        del file["entry/frame_log/kind"]
        file["entry/frame_log/kind"] = np.zeros(2, np.int32)
    with closing(RunFrames(tmp_path, told.append, clock)) as frames:
        assert _come(frames, clock) == [] and "Publishing of this run has ended" in told[0]
        with _written(tmp_path / "2026-01-01T000001_b") as writer:
            _append(writer, *SCAN[:2])
        assert len(_come(frames, clock)) == 2


@pytest.fixture
def image(loopback: dict[str, str]) -> Iterator[ImageServer]:
    with closing(ImageServer("T:Pva1:Image", "127.0.0.1", 0)) as server:
        yield server


def test_a_client_sees_pixels_number_and_attributes(image: ImageServer) -> None:
    from p4p.client.thread import Context

    with Context("pva", nt=False) as client:
        empty = client.get("T:Pva1:Image")
        assert (empty.uniqueId, empty.value) == (0, None)
        image.post(FRAME)
        value = client.get("T:Pva1:Image")
    assert value.getID() == "epics:nt/NTNDArray:1.0" and value.uniqueId == 7
    np.testing.assert_array_equal(value.value.reshape(3, 4), FRAME.counts)
    assert [(each.size, each.fullSize, each.offset, each.binning) for each in value.dimension] == [
        (4, 4, 0, 1), (3, 3, 0, 1),
    ]  # fmt: skip
    assert value.timeStamp.secondsPastEpoch + 1e-9 * value.timeStamp.nanoseconds == FRAME.time
    assert value.dataTimeStamp.nanoseconds == 250_000_000
    assert {each.name: each.value for each in value.attribute} == FRAME.attributes == {
        "ColorMode": 0, "Angle": 31.5, "Kind": "projection", "HDF5FrameLocation": "/exchange/data", "AcquireTime": 0.05,
    }  # fmt: skip


def test_a_port_that_is_taken_is_one_sentence(image: ImageServer, capfd: Any) -> None:
    with pytest.raises(
        DataError, match=rf"uses port {image.port} of 127\.0\.0\.1\. .* another --port, or leave out --port"
    ):
        ImageServer("T:Pva1:Image", "127.0.0.1", image.port)


def test_an_address_of_another_host_is_one_sentence(loopback: dict[str, str], capfd: Any) -> None:
    with pytest.raises(DataError, match=r"Clients cannot connect to the address 192\.0\.2\.1"):
        ImageServer("T:Pva1:Image", "192.0.2.1", 0)


@pytest.mark.parametrize("prefix", ["", "2bma", "2bm a:", "x" * 41 + ":", "pva://a:"])
def test_a_prefix_that_is_none_is_refused(prefix: str) -> None:
    result = beamline("publish", "--prefix", prefix)
    assert result.exit_code == 2 and "a colon at the end, such as 2bma:SPL:." in result.stderr


def test_libraries_that_are_missing_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "p4p.nt", None)
    with pytest.raises(ConfigError, match=r"splatline\[epics\]"):
        ImageServer("T:Pva1:Image", "127.0.0.1", 0)
    monkeypatch.setitem(sys.modules, "softioc", None)
    with pytest.raises(ConfigError, match=r"pip install softioc"):
        RecordServer("T:", (), "127.0.0.1", lambda name, value: None)


class Shown:
    """What a detector's records show, and what it said."""

    def __init__(self, files: Path | None) -> None:
        self.values: dict[str, Value] = {}
        self.said: list[str] = []
        self.detector = PublishedDetector(self.values.__setitem__, files, self.said.append)
        self.detector.began((3, 4), np.dtype(np.uint16))

    def ask(self, **values: Value) -> None:
        for name, value in values.items():
            self.detector.asked(name.replace("_", ":", 1), value)

    def take(self, n: int) -> None:
        for i in range(n):
            self.detector.take(replace(FRAME, unique_id=i + 1, counts=FRAME.counts + i))


def _capturing(files: Path, name: str = "a") -> Shown:
    shown = Shown(files)
    shown.ask(HDF1_FilePath=str(files), HDF1_FileName=name, HDF1_Capture=1)
    return shown


def test_a_client_that_acquires_counts_frames_of_the_scan_until_it_has_enough() -> None:
    shown = Shown(None)
    shown.take(2)
    shown.ask(cam1_ImageMode=1, cam1_NumImages=3, cam1_Acquire=1)
    assert (shown.values["cam1:Acquire_RBV"], shown.values["cam1:DetectorState_RBV"]) == (1, 1)
    shown.take(2)
    assert shown.values["cam1:NumImagesCounter_RBV"] == 2 and shown.values["cam1:Acquire_RBV"] == 1
    shown.take(2)
    assert shown.values["cam1:NumImagesCounter_RBV"] == 3
    assert (shown.values["cam1:Acquire_RBV"], shown.values["cam1:DetectorState_RBV"]) == (0, 0)
    assert shown.values["cam1:ArrayCounter_RBV"] == 6  # frames come in any case


def test_frames_are_captured_only_while_it_acquires(tmp_path: Path) -> None:
    shown = _capturing(tmp_path)
    shown.take(2)
    shown.ask(cam1_ImageMode=1, cam1_NumImages=3, cam1_Acquire=1)
    shown.take(5)
    assert shown.values["HDF1:NumCaptured_RBV"] == 3
    with h5py.File(tmp_path / "a.h5", "r", swmr=True) as file:
        shown.ask(HDF1_FlushNow=1)
        file["/entry/data/data"].refresh()
        assert file["/entry/data/data"].shape == (3, 3, 4)
    shown.ask(HDF1_Capture=0)
    with h5py.File(tmp_path / "a.h5") as file:
        np.testing.assert_array_equal(file["/entry/data/data"][2], FRAME.counts + 2)
        attributes = file["/entry/instrument/NDAttributes"]
        assert attributes["NDArrayUniqueId"][:].tolist() == [1, 2, 3]
        assert attributes["Angle"][0] == 31.5 and attributes["Kind"][0] == b"projection"
        assert attributes["NDArrayEpicsTSSec"][0] == 1.7e9 - 631152000


def test_a_scan_keeps_its_own_exposure_and_says_so_once() -> None:
    shown = Shown(None)
    shown.take(1)
    shown.ask(cam1_AcquireTime=0.01)
    shown.ask(cam1_AcquireTime=0.01)
    assert shown.values["cam1:AcquireTime_RBV"] == 0.05
    assert shown.said == ["A client asked for an exposure of 0.01 s. The scan keeps its exposure of 0.05 s."]


@pytest.mark.parametrize(
    ("asked", "why"),
    [
        ({"HDF1_FilePath": "/"}, "/ is not below the folder of --files, .*"),
        ({"HDF1_FileName": "../b"}, r"'\.\./b' with the template '%s%s\.h5' does not give a file name"),
        ({"HDF1_FileTemplate": "%s%999999d"}, "does not give a file name; expected %s%s.h5"),
        (
            {"HDF1_FileName": "taken"},
            r"taken\.h5 cannot be made: the file already exists, and this program does not overwrite files",
        ),
    ],
)
def test_a_file_that_cannot_be_written_is_told_to_client_and_operator(
    tmp_path: Path, asked: dict[str, Value], why: str
) -> None:
    (tmp_path / "taken.h5").touch()
    shown = Shown(tmp_path)
    shown.ask(**{"HDF1_FilePath": str(tmp_path), "HDF1_FileName": "a", **asked})
    shown.ask(HDF1_Capture=1, cam1_Acquire=1)
    shown.take(1)
    assert shown.values["HDF1:Capture_RBV"] == 0 and shown.values["HDF1:WriteStatus_RBV"] == 1
    (said,) = shown.said
    with pytest.raises(AssertionError, match=why):
        raise AssertionError(said)
    assert f"{shown.values['HDF1:WriteMessage_RBV']}"[:40] in said
    assert [path.name for path in tmp_path.iterdir()] == ["taken.h5"]


def test_without_a_folder_no_client_has_files_written(tmp_path: Path) -> None:
    shown = Shown(None)
    shown.ask(HDF1_FilePath=str(tmp_path), HDF1_FileName="a", HDF1_Capture=1)
    assert shown.values["HDF1:FilePathExists_RBV"] == 0
    assert "Start `beamline publish` with --files FOLDER" in shown.said[0]


def test_folders_are_made_only_below_that_of_files(tmp_path: Path) -> None:
    shown = Shown(tmp_path / "in")
    shown.ask(HDF1_CreateDirectory=-2, HDF1_FilePath=str(tmp_path / "in" / "a" / "b"))
    assert shown.values["HDF1:FilePathExists_RBV"] == 1 and (tmp_path / "in" / "a" / "b").is_dir()
    shown.ask(HDF1_FilePath=str(tmp_path / "out"))
    assert shown.values["HDF1:FilePathExists_RBV"] == 0 and not (tmp_path / "out").exists()


def test_frames_of_another_size_end_the_file_and_say_so(tmp_path: Path) -> None:
    shown = _capturing(tmp_path)
    shown.ask(cam1_Acquire=1)
    shown.take(1)
    shown.detector.take(replace(FRAME, counts=FRAME.counts[:2]))
    assert (
        r"the frames have the type uint16 and the shape (2, 4), but" in shown.said[0]
        and shown.values["HDF1:Capture_RBV"] == 0
    )
    with h5py.File(tmp_path / "a.h5") as file:
        assert len(file["/entry/data/data"]) == 1


def test_a_disk_that_takes_nothing_is_told(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot be made"):
        FrameFile(tmp_path / "no folder" / "a.h5", (3, 4), np.dtype(np.uint16))


def test_every_record_has_a_name_of_its_own() -> None:
    names = [
        f"{record.name}{suffix}"
        for record in records("T:Pva1:Image")
        for suffix, other in (("", Sides.READBACK), ("_RBV", Sides.SETPOINT))
        if record.sides is not other
    ]
    assert len(names) == len(set(names))
