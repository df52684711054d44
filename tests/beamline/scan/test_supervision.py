"""The policy of a check: what its alarms do to a scan, and after how many frames."""

import math
import re
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from beamline.core.errors import ScanStopped
from beamline.core.events import Event
from beamline.core.stop import Cause, PauseRequest, StopRequest
from beamline.instrument.connect import ConnectedDevices
from beamline.monitor.check import Flag, Level, Policy
from beamline.scan import recorder as recorder_module
from beamline.scan.control import State
from beamline.scan.supervision import (
    AlarmReaction,
    BeamGuard,
    BeamLimits,
    SpaceGuard,
)
from beamline.storage.readers.open import open_scan
from beamline.storage.writers.nxtomo import NXtomoWriter
from drivers.base.frame import Frame, FrameKind
from drivers.base.protocols import BeamReading
from tests.beamline.fakes import FakeInstrument, Faults, assert_true
from tests.beamline.ran import Ran


def flags(level: Level | None) -> tuple[Flag, ...]:
    return () if level is None else (Flag("beam", level, 0, 1.0, 0.5, "Look at the beam."),)


A, W, N = Level.ALARM, Level.WARN, None


@pytest.mark.parametrize(
    ("frames", "acts"),
    [
        ([A, A], 0),
        ([A, A, A], 1),
        ([A, A, W, A, A], 0),
        ([A, A, N, A, A], 0),
        ([W] * 9, 0),
        ([A] * 7, 2),
    ],
)
@pytest.mark.parametrize("policy", list(Policy))
def test_a_policy_is_carried_out_after_so_many_frames_in_a_row(
    policy: Policy, frames: list[Level | None], acts: int
) -> None:
    stop, pause = StopRequest(), PauseRequest()
    events: list[tuple[str, Mapping[str, Any]]] = []
    react = AlarmReaction(3, {"beam": policy}, stop, pause, lambda event: events.append((event.event, event.data)))
    held = 0
    for level in frames:
        react(flags(level))
        held += bool(pause.reason)
        pause.resume()
    assert held == acts * (policy is Policy.PAUSE)
    assert stop.stopping is (policy is Policy.STOP and acts > 0)
    assert len(events) == acts * (policy is Policy.WARN)
    for text in [data["message"] for _, data in events] + [stop.reason] * stop.stopping:
        assert (
            text.startswith("3 frames in a row have an alarm of the monitor's beam check: Look at the beam") or acts > 1
        )


@pytest.mark.parametrize(
    ("readings", "paused", "since"),
    [
        ([60, 51, 60], [0, 0, 0], math.inf),
        ([60, 49, 52, 54, 60, 60, 60], [0, 1, 1, 1, 1, 1, 0], 0),  # 52 and 54 are no beam yet
        ([10, 60, 60, 60], [1, 1, 1, 0], -math.inf),  # from before the start
        ([60, 60, 0, 60, 0, 60, 0, 60, 60, 60, 60], [0, 0, 1, 1, 1, 1, 1, 1, 1, 0, 0], 10),  # flapping
    ],
)
def test_too_little_beam_pauses_until_there_has_been_enough_for_a_while(
    readings: list[float], paused: list[bool], since: float
) -> None:
    pause = PauseRequest()
    guard, seen = BeamGuard(BeamLimits(50, 55, 20), pause), []
    for i, value in enumerate(readings):
        guard(BeamReading(value, "mA", 10.0 * i))
        seen.append(bool(pause.reason))
    assert seen == [bool(one) for one in paused]
    assert (pause.take_unlit_since(), pause.take_unlit_since()) == (since, math.inf)


def test_a_scan_without_beam_at_its_start_waits_for_it(tmp_path: Path) -> None:
    class Returning:
        name, at = "beam monitor", 0.0

        def reading(self) -> BeamReading:
            self.at += 10
            return BeamReading(0.0 if self.at < 25 else 100.0, "mA", self.at)

        def close(self) -> None: ...

    class Guarded(FakeInstrument):
        def connected(self) -> ConnectedDevices:
            return replace(super().connected(), beam_monitor=Returning())

    beam = (
        "devices.beam_monitor={kind: ring_current, url: 'file:///r', pattern: '(.)', period_s: 0.01, pause_below: 50}"
    )
    ran = Ran(tmp_path, Guarded(), beam)
    assert ran.error is None
    assert ran.states[:4] == [State.PREPARING, State.DARKS, State.PAUSED, State.DARKS]
    assert "reads 0 mA, less than 50. The scan goes on by itself" in ran.of("state")[2].data["message"]
    ran.assert_good_file(19, "complete")


WORDS = ("scan.angles.views=40", "monitor.act_after=2", "scan.settle_s=0")


@pytest.mark.parametrize("mode", ["step", "fly"])
def test_an_alarm_pauses_a_scan_with_a_closed_shutter_until_it_is_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: str
) -> None:
    monkeypatch.setattr(recorder_module, "WAITING_FRAMES", (1, 1))  # the writer keeps up with the virtual clock
    monkeypatch.setattr(recorder_module, "WAITING_BYTES", 1)
    monkeypatch.setattr(recorder_module, "BacklogGuard", lambda *_: lambda waiting: None)
    instrument = FakeInstrument(Faults(repeats={9, 10}))
    paused: list[tuple[str, bool]] = []

    def resume(event: Event) -> None:
        if event.data.get("state") == State.PAUSED:
            paused.append((event.data["message"], instrument.is_open))
            (run,) = tmp_path.iterdir()
            (run / "control" / "resume").touch()

    ran = Ran(tmp_path, instrument, *WORDS, "monitor.policy.stuck=pause", f"scan.mode={mode}", heard=resume)
    assert ran.result.n_frames == 47
    ((message, was_open),) = paused
    assert "Paused with a closed shutter: 2 frames in a row have an alarm of the monitor's stuck check" in message
    assert "`beamline resume` goes on" in message
    assert not was_open
    on = [State.TAXI, State.ACQUIRING] if mode == "fly" else [State.ACQUIRING]
    refs = [State.PREPARING, State.DARKS, State.FLATS]
    assert ran.states == [*refs, *on, State.PAUSED, *on, State.FLATS, State.FINISHING, State.DONE]
    with open_scan(ran.result.path) as source:
        assert source.finished
        views = [frame for frame in source.frames() if frame.kind is FrameKind.PROJECTION]
        assert [frame.trigger for frame in views] == list(range(40))
        assert_true(frame for frame in views if frame.index not in (9, 10))  # which show the frame before
        assert not [flag for flag in ran.of("flag") if flag.data["check"] == "timing"]  # it is no late frame
    ran.assert_safe()


def test_the_policy_stop_ends_the_scan_cleanly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder_module, "WAITING_FRAMES", (1, 1))
    words = (*WORDS, "monitor.policy.stuck=stop", "scan.mode=step")
    ran = Ran(tmp_path, FakeInstrument(Faults(repeats={9, 10})), *words)
    assert type(ran.error) is ScanStopped
    assert "2 frames in a row have an alarm of the monitor's stuck check" in str(ran.error)
    n = ran.of("scan_done")[0].data["n_frames"]
    assert 11 <= n < 20
    ran.assert_safe()


def test_a_scan_pauses_before_its_disk_is_full_and_goes_on_when_there_is_space() -> None:
    pause = PauseRequest()
    look, mb = SpaceGuard(100_000_000, pause), 1_000_000
    steps = [(500, 900, ""), (121, 800, ""), (119, 790, "119 MB are free.* 790 MB are still to come.* at 220 MB")]
    for free, left, said in [*steps, (219, 790, "Free some"), (220, 790, ""), (119, 790, "Free some")]:
        look(free * mb, left * mb)
        assert re.search(said, pause.reason) if said else pause.reason == ""
    look(119 * mb, 99 * mb)  # what is still to come fits
    assert pause.reason == ""


def test_what_holds_a_scan_ends_by_itself_alone() -> None:
    pause = PauseRequest()
    pause.hold(Cause.SPACE, "full")
    pause.no_beam("dark", 0.0)
    pause.pause()
    pause.resume()
    pause.release(Cause.BEAM)
    assert pause.reason == "full"
    pause.pause("look")
    pause.release(Cause.SPACE)
    assert pause.reason.startswith("look")
    pause.resume()
    assert pause.reason == ""


def test_a_scan_waits_for_space_on_its_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another program takes it while the ninth frame is exposed, and gives it back when the scan has paused."""
    free = [10**12]
    monkeypatch.setattr(recorder_module, "LOOK", 0.01)
    monkeypatch.setattr(recorder_module.shutil, "disk_usage", lambda path: SimpleNamespace(free=free[0]))

    def take() -> None:
        free[0] = 10**6
        time.sleep(0.2)

    def give_back(event: Event) -> None:
        if event.data.get("state") is State.PAUSED:
            assert "1 MB are free on the scan's disk" in event.data["message"]
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
        append, put = NXtomoWriter.append, recorder_module.Recorder.put

        def late(writer: NXtomoWriter, frame: Frame, *row: Any) -> None:
            is_behind = behind.pop(frame.kind, lambda: True)
            end = time.monotonic() + 30.0
            while not is_behind() and time.monotonic() < end:
                time.sleep(0.001)
            append(writer, frame, *row)

        def noted(recorder: recorder_module.Recorder, frame: Frame) -> None:
            put(recorder, frame)
            self.waiting = recorder._waiting.qsize()
            self.most_waiting = max(self.most_waiting, self.waiting)

        patch.setattr(recorder_module, "WAITING_FRAMES", (room, room))
        patch.setattr(NXtomoWriter, "append", late)
        patch.setattr(recorder_module.Recorder, "put", noted)

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
    behind = {FrameKind.DARK: lambda: disk.waiting == 4, FrameKind.PROJECTION: lambda: disk.paused}
    disk = SlowDisk(monkeypatch, 4, behind)
    ran = Ran(tmp_path, FakeInstrument(), "scan.mode=fly", "scan.darks.count=12", heard=disk.heard)
    assert ran.error is None
    assert ran.states[:4] == [State.PREPARING, State.DARKS, State.FLATS, State.TAXI]
    assert State.PAUSED in ran.states


@pytest.mark.parametrize("block", [State.FLATS, State.ACQUIRING])
def test_a_loss_of_beam_read_after_the_last_frame_of_a_block_is_mended(tmp_path: Path, block: State) -> None:
    """The reading after the last view (or flat) is without beam, the next one with: what came since is taken again."""
    instrument, lost = FakeInstrument(), threading.Event()

    class Beam:
        name = "beam monitor"

        def reading(self) -> BeamReading:
            time.sleep(0.01)
            value = 0.0 if lost.is_set() else 100.0
            lost.clear()
            return BeamReading(value, "mA", instrument.clock.now())

        def close(self) -> None: ...

    instrument.at = {4 if block is State.FLATS else 16: lost.set}
    devices = replace(instrument.connected(), beam_monitor=Beam())
    instrument.connected = lambda: devices  # type: ignore[method-assign]
    beam = (
        "devices.beam_monitor={kind: ring_current, url: 'file:///r', pattern: '(.)', period_s: 0.05, pause_below: 50,"
        " settle_s: 0}"
    )
    ran = Ran(tmp_path, instrument, beam)
    with open_scan(ran.result.path) as source:
        kinds = [FrameKind.FLAT if block is State.FLATS else FrameKind.PROJECTION]
        again = [frame for frame in source.frames() if frame.replaces >= 0]
        assert again and {frame.kind for frame in again} == set(kinds)
        assert (source.image_key == FrameKind.PROJECTION).sum() == 12
    frames = ran.of("frame")
    assert all(event.data["n"] <= event.data["of"] for event in frames)
    assert frames[-1].data["n"] == frames[-1].data["of"] == ran.result.n_frames
