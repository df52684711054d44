"""The scintillator is exposed for the warm-up time before each frame with beam, if the shutter was closed."""

from dataclasses import replace

import pytest

from beamline.core.stop import StopRequest
from beamline.plan.plan import Mode, Place
from drivers.base.frame import FrameKind
from tests.beamline.acquired import Run, assert_safe
from tests.beamline.fakes import FakeInstrument

WARM = 30.0


def _run(at: Place, warm_up: float, stop: StopRequest | None = None) -> tuple[Run, FakeInstrument, float]:
    instrument = FakeInstrument()
    timeline = instrument.worked_out(replace(instrument.plan(mode=Mode.STEP, at=at), warm_up=warm_up))
    return Run(instrument, timeline, stop), instrument, timeline.duration


@pytest.mark.parametrize("at", [Place.START, Place.BOTH, Place.END])
def test_frames_with_light_come_after_it_and_no_others(at: Place) -> None:
    plain, _, before = _run(at, 0.0)
    warm, instrument, planned = _run(at, WARM)
    assert planned - before == pytest.approx(WARM)
    late = [there.time - here.time for here, there in zip(plain.frames, warm.frames, strict=True)]
    kinds = [frame.kind for frame in warm.frames]
    lit = next(i for i, kind in enumerate(kinds) if kind is not FrameKind.DARK)
    assert late == pytest.approx([0.0] * lit + [WARM] * (len(kinds) - lit), abs=0.01)
    (said,) = [data["message"] for event, data in warm.events if event == "state" and "Warming" in data["message"]]
    assert said == "Warming up the scintillator for 30 s"
    assert_safe(instrument)


def test_a_stop_ends_the_wait() -> None:
    stop = StopRequest()
    instrument = FakeInstrument(at={2: stop.stop})  # the last dark
    timeline = instrument.worked_out(replace(instrument.plan(mode=Mode.STEP), warm_up=1e5))
    began = instrument.clock.now()
    run = Run(instrument, timeline, stop)
    assert run.error is not None and instrument.clock.now() - began < 100
    assert_safe(instrument)
