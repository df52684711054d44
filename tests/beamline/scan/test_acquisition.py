"""Every frame has the angle of its exposure, missing frames are named, and the instrument ends in a safe state."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamline.core.errors import InstrumentError
from beamline.plan.plan import Mode, Place
from beamline.plan.timeline import block_seconds
from beamline.scan.ledger import LedgerError
from drivers.base.frame import FrameKind
from drivers.base.protocols import CameraTiming
from tests.beamline.acquired import Run, assert_safe
from tests.beamline.fakes import COUNT, Camera, FakeInstrument, Faults, assert_true


@pytest.mark.parametrize(("mode", "passes"), [(Mode.FLY, 1), (Mode.FLY, 3), (Mode.STEP, 1)])
@pytest.mark.parametrize("at", [Place.START, Place.BOTH])
def test_a_scan_is_its_plan_frame_by_frame(mode: Mode, passes: int, at: Place) -> None:
    instrument = FakeInstrument()
    timeline = instrument.timeline(n=12, mode=mode, passes=passes, at=at)
    run = Run(instrument, timeline)
    assert run.error is None
    D, F, P = FrameKind.DARK, FrameKind.FLAT, FrameKind.PROJECTION
    after = [F] * 2 + [D] * 3 if at is Place.BOTH else []
    assert [f.kind for f in run.frames] == [D] * 3 + [F] * 2 + [P] * 12 + after
    assert [f.index for f in run.frames] == list(range(timeline.n_frames))
    assert [f.exposure for f in run.frames][:6] == [0.02] * 3 + [0.03] * 2 + [0.02]
    assert_true(run.frames, COUNT / 2)
    planned = timeline.views
    np.testing.assert_allclose([f.angle for f in run.of(P)], planned.angles, atol=COUNT / 2)
    assert run.views == list(range(12))
    assert np.all(np.diff([f.time for f in run.frames]) > 0)
    assert not any(np.shares_memory(a.counts, b.counts) for a, b in itertools.pairwise(run.frames))
    assert run.scan.missing == []
    assert_safe(instrument)
    assert [e for e, _ in run.events] == ["block_started", "block_done"] * len(timeline.blocks)
    done = [data for event, data in run.events if event == "block_done"]
    assert [data["frames"] for data in done] == [block.n for block in timeline.blocks]
    assert {(data["lost"], data["ignored"], data["extra"], len(data["missing"])) for data in done} == {(0, 0, 0, 0)}


def test_between_frames_of_a_view_the_stage_neither_moves_nor_settles() -> None:
    instrument = FakeInstrument()
    plan = instrument.plan(n=4, mode=Mode.STEP)
    plan = replace(plan, angles=np.repeat(plan.angles, 3), frames_per_view=3, period=0.03)
    timeline = instrument.worked_out(plan)
    run = Run(instrument, timeline)
    assert run.error is None
    assert_true(run.frames, COUNT / 2)
    views = run.of(FrameKind.PROJECTION)
    np.testing.assert_allclose([frame.angle for frame in views], plan.angles, atol=COUNT / 2)
    waits = np.diff([frame.time for frame in views])
    assert (np.delete(waits, [2, 5, 8]) < 0.1).all() and (waits[[2, 5, 8]] > 0.5).all()
    planned = block_seconds(timeline.views, instrument.stage.limits, instrument.camera.timing, plan.settle)
    assert planned == pytest.approx(views[-1].time - views[0].time, abs=0.2)


@given(st.sets(st.integers(0, 23), max_size=5), st.sets(st.integers(0, 23), max_size=4), st.sampled_from([1, 2, 3]))
def test_fly_any_lost_and_ignored_triggers_are_named(lost: set[int], ignored: set[int], passes: int) -> None:
    first = 5  # triggers before the views: 3 darks and 2 flats
    instrument = FakeInstrument(Faults(lost={first + i for i in lost}, ignored={first + i for i in ignored}))
    n = 24
    gone = sorted(lost | ignored)
    run = Run(instrument, instrument.timeline(n=n, passes=passes))
    assert_true(run.frames, COUNT / 2)
    if not gone:
        assert run.error is None
        return
    per_pass = n // passes
    silent = [p for p in range(passes) if set(range(p * per_pass, (p + 1) * per_pass)) <= set(gone)]
    if silent:  # not one frame of a whole pass: the instrument is at fault, and there is no point in going on
        assert isinstance(run.error, InstrumentError)
        assert_safe(instrument, home=False)
        n = (silent[0] + 1) * per_pass
    else:
        assert isinstance(run.error, LedgerError)
        assert run.error.missing == tuple(run.scan.missing)
        assert f"{len(gone)} of 24 projections {'is' if len(gone) == 1 else 'are'} missing" in str(run.error)
        assert_safe(instrument)
    assert run.views == [i for i in range(n) if i not in gone]
    assert run.scan.missing == [first + i for i in gone if i < n]


@given(st.sets(st.integers(0, 16)))
def test_step_lost_frames_are_named_and_the_scan_goes_on(lost: set[int]) -> None:
    instrument = FakeInstrument(Faults(lost=lost))
    run = Run(instrument, instrument.timeline(n=12, mode=Mode.STEP))
    assert_true(run.frames, COUNT / 2)
    runs_of_three = [i for i in range(15) if {i, i + 1, i + 2} <= lost and not (i < 3 <= i + 2 or i < 5 <= i + 2)]
    if runs_of_three:
        assert isinstance(run.error, InstrumentError)
        assert "in a row" in str(run.error)
        before = {FrameKind.DARK: 0, FrameKind.FLAT: 3, FrameKind.PROJECTION: 5}
        assert [f.trigger + before[f.kind] for f in run.frames] == [
            i for i in range(min(runs_of_three) + 3) if i not in lost
        ]
    else:
        assert run.scan.missing == sorted(lost)
        assert isinstance(run.error, LedgerError) or not lost
        assert len(run.frames) == 17 - len(lost)
    assert_safe(instrument, home=not runs_of_three)


def test_frames_that_no_trigger_made_become_invalid_rows() -> None:
    instrument = FakeInstrument(Faults(extra_after={9, 16}))
    run = Run(instrument, instrument.timeline(n=12))
    assert run.views == list(range(12))
    invalid = run.of(FrameKind.INVALID)
    assert [f.trigger for f in invalid] == [-1, -1]
    np.testing.assert_allclose(np.degrees([f.angle for f in invalid]), [4 * 15 + 7.5, 11 * 15], atol=0.3)
    assert [f.index for f in run.frames] == list(range(19))
    assert isinstance(run.error, LedgerError)
    assert "2 frames came without a trigger" in str(run.error)
    assert run.error.missing == ()
    assert_safe(instrument)


@pytest.mark.parametrize("acceleration", [200.0, 60.0], ids=["start known", "start vague"])
@pytest.mark.parametrize("early", [0.6, 0.3, 0.15])
def test_noise_before_triggers_is_invalid_and_every_view_keeps_its_angle(acceleration: float, early: float) -> None:
    """Trigger 5 is the first of the views: noise before it was view 0, and the views after it were invalid or shifted;
    noise before trigger 9 took the place of the view."""
    instrument = FakeInstrument(Faults(noise={5: early, 9: early}))
    instrument.stage.limits = replace(instrument.stage.limits, acceleration=np.radians(acceleration).item())
    run = Run(instrument, instrument.timeline(n=36, speed=55))
    assert run.views == list(range(36))
    assert_true(run.frames, COUNT / 2)
    assert [f.index for f in run.of(FrameKind.INVALID)] == [5, 10]
    assert "2 frames came without a trigger" in str(run.error)
    assert "may" not in str(run.error)
    assert_safe(instrument)


def test_a_stop_or_a_silent_camera_loses_no_frame_that_waited_for_the_next() -> None:
    instrument = FakeInstrument(Faults(noise={5: 0.6}, ignored=set(range(7, 200))))
    run = Run(instrument, instrument.timeline(n=40, speed=3))
    assert isinstance(run.error, InstrumentError) and "no frame for" in str(run.error)
    assert len(run.frames) == 3 + 2 + 3
    assert_safe(instrument, home=False)


class Dawdling(Camera):
    """Slow to be ready again, and every second trigger is fired only 10 ms after the call."""

    @property
    def timing(self) -> CameraTiming:
        return replace(super().timing, min_period=self.settings.exposure + 0.05)

    def software_trigger(self) -> None:
        self.instrument.clock.sleep(0.01 * (1 - self.number % 2))
        super().software_trigger()


@pytest.mark.parametrize("mode", [Mode.FLY, Mode.STEP])
def test_software_triggers_leave_the_least_period_between_exposures_whenever_the_camera_fires(mode: Mode) -> None:
    instrument = FakeInstrument()
    instrument.camera = Dawdling(instrument)
    instrument.devices = replace(instrument.devices, camera=instrument.camera)
    run = Run(instrument, instrument.timeline(n=8, mode=mode), None)
    assert run.error is None
    for kind, exposure in ((FrameKind.DARK, 0.02), (FrameKind.FLAT, 0.03), (FrameKind.PROJECTION, 0.02)):
        assert np.diff([frame.time for frame in run.of(kind)]).min() > exposure + 0.05 - 1e-6
