"""A scan waits for free memory and disk space, and continues when there is some."""

import re
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from beamline.core.events import Event
from beamline.core.stop import PauseRequest
from beamline.scan import backlog, recorder
from beamline.scan.backlog import hold_for_space
from beamline.scan.control import State
from beamline.storage.writers.nxtomo import NXtomoWriter
from drivers.base.frame import Frame, FrameKind
from tests.beamline.fakes import FakeInstrument
from tests.beamline.ran import Ran


def test_a_scan_pauses_before_its_disk_is_full_and_goes_on_when_there_is_space() -> None:
    pause = PauseRequest()
    look, mb = partial(hold_for_space, pause, 100_000_000), 1_000_000
    steps = [
        (500, 900, ""),
        (121, 800, ""),
        (119, 790, "119 MB are free.* 790 MB are still to be written.* when 220 MB"),
    ]
    for free, left, said in [*steps, (219, 790, "Free some"), (220, 790, ""), (119, 790, "Free some")]:
        look(free * mb, left * mb)
        assert re.search(said, pause.reason) if said else pause.reason == ""
    look(119 * mb, 99 * mb)  # what is still to come fits
    assert pause.reason == ""


def test_a_scan_waits_for_space_on_its_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another program takes it while the ninth frame is exposed, and gives it back when the scan has paused."""
    free = [10**12]
    monkeypatch.setattr(backlog, "LOOK", 0.01)
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=free[0]))

    def take() -> None:
        free[0] = 10**6
        time.sleep(0.2)

    def give_back(event: Event) -> None:
        if event.data.get("state") is State.PAUSED:
            assert "1 MB are free" in event.data["message"]
            free[0] = 10**12

    ran = Ran(tmp_path, FakeInstrument(at={8: take}), heard=give_back)
    assert ran.error is None
    assert State.PAUSED in ran.states
    ran.assert_good_file(3 + 2 + 12 + 2, "complete")


class SlowDisk:
    """A writer that waits at the first frame of some kinds until `behind` is true for them; the queue holds `room`."""

    def __init__(self, patch: pytest.MonkeyPatch, room: int, behind: Mapping[FrameKind, Callable[[], bool]]) -> None:
        self.waiting, self.most_waiting, self.paused = 0, 0, False
        behind = dict(behind)
        append, put = NXtomoWriter.append, recorder.Recorder.put

        def late(writer: NXtomoWriter, frame: Frame, *row: Any) -> None:
            is_behind = behind.pop(frame.kind, lambda: True)
            end = time.monotonic() + 30.0
            while not is_behind() and time.monotonic() < end:
                time.sleep(0.001)
            append(writer, frame, *row)

        def noted(recording: recorder.Recorder, frame: Frame) -> None:
            put(recording, frame)
            self.waiting = recording._waiting.qsize()
            self.most_waiting = max(self.most_waiting, self.waiting)

        patch.setattr(backlog, "WAITING_FRAMES", (room, room))
        patch.setattr(NXtomoWriter, "append", late)
        patch.setattr(recorder.Recorder, "put", noted)

    def heard(self, event: Event) -> None:
        self.paused |= event.data.get("state") is State.PAUSED


def test_a_fly_scan_pauses_before_frames_find_no_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = SlowDisk(monkeypatch, 8, {FrameKind.PROJECTION: lambda: disk.paused})
    ran = Ran(tmp_path, FakeInstrument(), "scan.mode=fly", "scan.angles.views=36", heard=disk.heard)
    assert ran.error is None
    assert disk.paused and disk.most_waiting < 8
    ran.assert_good_file(3 + 2 + 36 + 2, "complete")


def test_a_step_scan_waits_for_a_slow_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = SlowDisk(monkeypatch, 8, {FrameKind.PROJECTION: lambda: disk.waiting == 8})
    ran = Ran(tmp_path, FakeInstrument(), "scan.mode=step", "scan.angles.views=36", heard=disk.heard)
    assert ran.error is None
    assert disk.most_waiting == 8 and not disk.paused
    ran.assert_good_file(3 + 2 + 36 + 2, "complete")


def test_a_slow_disk_pauses_views_but_no_darks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk: SlowDisk
    behind = {FrameKind.DARK: lambda: disk.waiting == 4, FrameKind.PROJECTION: lambda: disk.paused}
    disk = SlowDisk(monkeypatch, 4, behind)
    ran = Ran(tmp_path, FakeInstrument(), "scan.mode=fly", "scan.darks.count=12", heard=disk.heard)
    assert ran.error is None
    assert ran.states[:4] == [State.PREPARING, State.DARKS, State.FLATS, State.TAXI]
    assert State.PAUSED in ran.states
