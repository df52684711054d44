"""The scintillator has light for the warm-up before each frame with light, whenever the shutter has been closed."""

from __future__ import annotations

from dataclasses import replace

import pytest

from beamline.core.stop import StopRequest
from beamline.plan.plan import Mode, Place
from beamline.plan.timeline import work_out
from drivers.base.frame import FrameKind
from tests.beamline.acquired import Run, assert_safe
from tests.beamline.fakes import FakeInstrument

WARM = 30.0


def _run(at: Place, warm_up: float, stop: StopRequest | None = None) -> tuple[Run, FakeInstrument, float]:
    instrument = FakeInstrument()
    plan = replace(instrument.plan(mode=Mode.STEP, at=at), warm_up=warm_up)
    stage, camera = instrument.stage, instrument.camera
    timeline = work_out(plan, stage.limits, stage.to_counts, camera.timing)
    return Run(instrument, timeline, stop), instrument, timeline.duration


@pytest.mark.parametrize(("at", "times"), [(Place.START, 1), (Place.BOTH, 1), (Place.END, 1)])
def test_frames_with_light_come_after_it_and_no_others(at: Place, times: int) -> None:
    plain, _, before = _run(at, 0.0)
    warm, instrument, planned = _run(at, WARM)
    assert planned - before == pytest.approx(times * WARM)
    late = [there.time - here.time for here, there in zip(plain.frames, warm.frames, strict=True)]
    kinds = [frame.kind for frame in warm.frames]
    lit = next(i for i, kind in enumerate(kinds) if kind is not FrameKind.DARK)
    assert late == pytest.approx([0.0] * lit + [WARM] * (len(kinds) - lit), abs=0.01)
    (said,) = [data["message"] for event, data in warm.events if event == "state" and "warms" in data["message"]]
    assert said == "The scintillator warms up for 30 s"
    assert_safe(instrument)


def test_a_stop_ends_the_wait() -> None:
    stop = StopRequest()
    instrument = FakeInstrument(on_frame=lambda number: stop.stop() if number == 2 else None)  # the last dark
    plan = replace(instrument.plan(mode=Mode.STEP), warm_up=1e5)
    timeline = work_out(plan, instrument.stage.limits, instrument.stage.to_counts, instrument.camera.timing)
    began = instrument.clock.now()
    run = Run(instrument, timeline, stop)
    assert run.error is not None and instrument.clock.now() - began < 100
    assert_safe(instrument)
