"""Too little beam pauses a scan until it is back, and spoilt projections are repeated."""

import math
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest

from beamline.core.stop import Cause, PauseRequest
from beamline.instrument.connect import ConnectedDevices
from beamline.scan.control import State
from beamline.scan.supervision import BeamGuard
from beamline.storage.readers.open import open_scan
from drivers.base.frame import FrameKind
from drivers.base.protocols import BeamReading
from tests.beamline.fakes import FakeInstrument
from tests.beamline.ran import Ran


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
    guard, seen = BeamGuard(50, 55, 20, pause), []
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
    assert "reads 0 mA, less than 50. The scan continues automatically" in ran.of("state")[2].data["message"]
    ran.assert_good_file(19, "complete")


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
        assert (source.table.kinds == FrameKind.PROJECTION).sum() == 12
    frames = ran.of("frame")
    assert all(event.data["n"] <= event.data["of"] for event in frames)
    assert frames[-1].data["n"] == frames[-1].data["of"] == ran.result.n_frames
