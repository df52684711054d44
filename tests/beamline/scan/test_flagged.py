"""Policy of a check: what its alarms do to a scan, and after how many frames."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from beamline.core.errors import ScanStopped
from beamline.core.events import Event
from beamline.core.stop import PauseRequest, StopRequest
from beamline.monitor.check import Flag, Level, Policy
from beamline.scan import backlog, recorder
from beamline.scan.control import State
from beamline.scan.flagged import AlarmReaction
from beamline.storage.readers.open import open_scan
from drivers.base.frame import FrameKind
from tests.beamline.fakes import FakeInstrument, Faults, assert_true
from tests.beamline.ran import Ran
from tests.slow_cases import others_slow


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
            text.startswith(
                "the check `beam` of the monitor raised an alarm for 3 consecutive frames: Look at the beam"
            )
            or acts > 1
        )


WORDS = ("scan.angles.views=40", "monitor.act_after=2", "scan.settle_s=0")


@pytest.mark.parametrize("mode", others_slow(["step", "fly"]))
def test_an_alarm_pauses_a_scan_with_a_closed_shutter_until_it_is_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: str
) -> None:
    monkeypatch.setattr(backlog, "WAITING_FRAMES", (1, 1))  # the writer keeps up with the virtual clock
    monkeypatch.setattr(backlog, "WAITING_BYTES", 1)
    monkeypatch.setattr(recorder, "hold_for_backlog", lambda *_: None)
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
    assert "closed shutter: the check `stuck` of the monitor raised an alarm for 2 consecutive frames" in message
    assert "use `beamline resume` to continue" in message
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
    monkeypatch.setattr(backlog, "WAITING_FRAMES", (1, 1))
    words = (*WORDS, "monitor.policy.stuck=stop", "scan.mode=step")
    ran = Ran(tmp_path, FakeInstrument(Faults(repeats={9, 10})), *words)
    assert type(ran.error) is ScanStopped
    assert "the check `stuck` of the monitor raised an alarm for 2 consecutive frames" in str(ran.error)
    n = ran.of("scan_done")[0].data["n_frames"]
    assert 11 <= n < 20
    ran.assert_safe()
