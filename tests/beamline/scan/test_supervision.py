"""The policy of a check: what its alarms do to a scan, and after how many frames."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from beamline.core.errors import ScanStopped
from beamline.core.stop import HoldRequest, StopRequest
from beamline.monitor.check import Flag, Level, Policy
from beamline.scan import recorder as recorder_module
from beamline.scan.supervision import AlarmPolicy, AlarmReaction
from beamline.storage.readers.open import open_scan
from drivers.errors import DeviceError
from drivers.frame import FrameKind
from tests.beamline.fakes import COUNT, FakeInstrument, Faults, decode
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
    stop, hold = StopRequest(), HoldRequest()
    events: list[tuple[str, Mapping[str, Any]]] = []
    react = AlarmReaction(
        AlarmPolicy(act_after=3, policies={"beam": policy}), stop, hold, lambda kind, data: events.append((kind, data))
    )
    held = 0
    for level in frames:
        react(flags(level))
        held += hold.take() is not None
    assert held == acts * (policy is Policy.PAUSE)
    assert stop.stopping is (policy is Policy.STOP and acts > 0)
    assert len(events) == acts * (policy is Policy.WARN)
    for text in [data["message"] for _, data in events] + [stop.reason] * stop.stopping:
        assert (
            text.startswith("3 frames in a row have an alarm of the monitor's beam check: Look at the beam") or acts > 1
        )


WORDS = ("scan.angles.views=40", "monitor.act_after=2", "scan.settle_s=0")


@pytest.mark.parametrize("mode", ["step", "fly"])
def test_a_held_scan_closes_the_shutter_asks_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: str
) -> None:
    monkeypatch.setattr(recorder_module, "WAITING_FRAMES", (1, 1))  # the writer keeps up with the virtual clock
    monkeypatch.setattr(recorder_module, "WAITING_BYTES", 1)
    angles = "scan.angles={scheme: interlaced, views: 40, passes: 2, start_deg: 0, span_deg: 180}"
    instrument = FakeInstrument(Faults(repeats={9, 10}))
    asked: list[tuple[str, bool]] = []
    ran = Ran(
        tmp_path,
        instrument,
        *WORDS,
        "monitor.policy.stuck=pause",
        f"scan.mode={mode}",
        *([angles] if mode == "fly" else []),
        ask=lambda request: asked.append((request, instrument.is_open)),
    )
    assert ran.error is None and ran.result is not None and ran.result.n_frames == 47
    ((request, was_open),) = asked
    assert "held: 2 frames in a row have an alarm of the monitor's stuck check" in request
    assert not was_open
    assert ran.states == ["preparing", "acquiring", "held", "acquiring", "stopping", "done"]
    with open_scan(ran.result.path) as source:
        assert source.finished
        for frame in source.frames():
            if frame.index not in (9, 10):  # those that show the frame before
                count, is_open, _, _ = decode(frame.counts)
                assert frame.angle == pytest.approx(count * COUNT, abs=COUNT)
                assert is_open is (frame.kind is not FrameKind.DARK)
    ran.assert_safe()


def test_a_scan_that_is_held_where_nobody_is_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder_module, "WAITING_FRAMES", (1, 1))

    def nobody(request: str) -> None:
        raise DeviceError("operator", "there is no terminal to ask at")

    words = (*WORDS, "monitor.policy.stuck=pause", "scan.mode=step")
    ran = Ran(tmp_path, FakeInstrument(Faults(repeats={9, 10})), *words, ask=nobody)
    assert type(ran.error) is ScanStopped
    assert "nobody let it go on" in str(ran.error)
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
