"""A scan that is paused at any moment gives the same frames as one without a pause: none lost, none twice."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beamline.core.errors import ScanStopped
from beamline.core.events import Event
from beamline.core.stop import Cause, PauseRequest, ScanAborted, StopRequest
from beamline.plan.passes import Choice, Passes
from beamline.plan.plan import Mode, Place
from beamline.scan.control import State, StateMachine
from beamline.scan.supervision import Supervision
from drivers.base.frame import Frame, FrameKind
from drivers.base.protocols import CameraFrame
from drivers.in_beam import ManualShutter
from tests.beamline.acquired import Run, assert_safe
from tests.beamline.chosen import Scripted
from tests.beamline.fakes import Camera, Exposed, FakeInstrument, Faults, assert_true

FIRST = 5  # triggers before the views: 3 darks and 2 flats


class Still(Camera):
    """The noise follows from where the stage is, and no pixel from how many triggers there were before."""

    def _expose(self, time: float, number: int, count: int) -> None:
        super()._expose(time, number, count)
        if self.ring:
            self.ring[-1] = replace(self.ring[-1], state=(*self.ring[-1].state[:3], 0))

    def _take(self, frame: Exposed) -> CameraFrame:
        self.rng = np.random.default_rng(frame.state[0])
        return super()._take(frame)


class Paused:
    """A fake instrument whose scan is resumed as soon as it is paused; what it was then is noted."""

    def __init__(self, faults: Faults | None = None, stop: StopRequest | None = None) -> None:
        self.pause, self.stop = PauseRequest(), stop
        self.instrument = FakeInstrument(faults)
        self.instrument.camera = Still(self.instrument)
        self.instrument.devices = replace(self.instrument.devices, camera=self.instrument.camera)
        self.states: list[State] = []
        self.at_rest: list[bool] = []
        self.machine = StateMachine(self._told, State.PREPARING)

    def _told(self, event: Event) -> None:
        self.states.append(event.data["state"])
        if event.data["state"] is State.PAUSED:
            self.at_rest.append(not self.instrument.is_open and not self.instrument.stage.moving())
            self.pause.resume()
            self.pause.release(Cause.BEAM)
            self.pause.release(Cause.BACKLOG)

    def at_frame(self, number: int) -> Paused:
        self.instrument.at = {number: self.pause.pause}
        return self

    def at_times(self, seconds: list[float]) -> Paused:
        """Virtual s after now."""
        clock, due = self.instrument.clock, sorted(self.instrument.clock.now() + at for at in seconds)
        sleep = clock.sleep

        def on_the_way(seconds: float) -> None:
            sleep(seconds)
            while due and clock.now() >= due[0]:
                due.pop(0)
                self.pause.pause()

        clock.sleep = on_the_way  # type: ignore[method-assign]
        return self

    def run(
        self,
        n: int,
        mode: Mode = Mode.FLY,
        passes: int = 1,
        at: Place = Place.START,
        speed: float = 30,
        choose: Callable[[Passes], Choice] | None = None,
    ) -> Run:
        supervision = Supervision(pause=self.pause, wait_in_pause=lambda: False, states=self.machine, next_pass=choose)
        return Run(self.instrument, self.instrument.timeline(n, mode, passes, at, speed), self.stop, supervision)


def assert_same(frames: list[Frame], whole: list[Frame]) -> None:
    def facts(frame: Frame) -> tuple[object, ...]:
        return frame.kind, frame.index, frame.trigger, frame.angle, frame.exposure, frame.replaces

    assert [facts(f) for f in frames if f.kind is not FrameKind.DARK] == [
        facts(f) for f in whole if f.kind is not FrameKind.DARK
    ]
    np.testing.assert_array_equal([frame.counts for frame in frames], [frame.counts for frame in whole])


def whole(n: int, mode: Mode = Mode.FLY, passes: int = 1, at: Place = Place.START, speed: float = 30) -> list[Frame]:
    run = Paused().run(n, mode, passes, at, speed)
    assert run.error is None
    return run.frames


@pytest.mark.parametrize(("speed", "passes"), [(30, 1), (55, 1), (30, 2)])
def test_a_fly_scan_paused_at_any_frame_is_pixel_for_pixel_the_one_that_was_not(speed: float, passes: int) -> None:
    expected = whole(12, passes=passes, speed=speed)
    for number in range(FIRST, FIRST + 12):
        paused = Paused().at_frame(number)
        run = paused.run(12, passes=passes, speed=speed)
        assert run.error is None, number
        assert_same(run.frames, expected)
        assert all(paused.at_rest)
        assert len(paused.at_rest) == 1 or number == FIRST + 11  # after the last frame there is nothing to wait for
        assert_safe(paused.instrument)


@settings(max_examples=15, deadline=None)
@given(st.lists(st.floats(0, 12), max_size=4), st.sampled_from([(Mode.FLY, 1), (Mode.FLY, 3), (Mode.STEP, 1)]))
def test_a_scan_paused_at_any_times_is_the_one_that_was_not(times: list[float], how: tuple[Mode, int]) -> None:
    """Also in darks and flats, on the way to the start, during the run-up, and while it brakes for the pause before."""
    paused = Paused().at_times(times)
    run = paused.run(12, *how, at=Place.BOTH)
    assert run.error is None
    assert_same(run.frames, whole(12, *how, at=Place.BOTH))
    assert all(paused.at_rest) and len(paused.at_rest) <= len(times)
    assert_safe(paused.instrument)


@pytest.mark.parametrize(("mode", "passes"), [(Mode.FLY, 1), (Mode.FLY, 4), (Mode.STEP, 1)])
@pytest.mark.parametrize("number", [1, 3, 4, 8, 11, 16])
def test_frames_since_the_last_beam_are_taken_again_in_their_place(mode: Mode, passes: int, number: int) -> None:
    """Frames 0 to 2 are darks, which need no beam; 3 and 4 are flats. The last two frames may have had none."""
    paused = Paused()
    times: list[float] = []

    def lost(seen: int) -> None:
        times.append(paused.instrument.clock.now())
        if len(times) - 1 == number:
            paused.pause.no_beam("no beam", since=times[max(number - 2, 0)])

    paused.instrument.on_frame = lost
    run = paused.run(12, mode, passes, speed=20)
    assert run.error is None
    replaced = {frame.replaces for frame in run.frames} - {-1}
    assert replaced == set(range(max(number - 1, FIRST if number >= FIRST else 3), number + 1)) - {0, 1, 2}
    kept = [frame for frame in run.frames if frame.index not in replaced]
    assert_same(
        [replace(frame, index=i, replaces=-1) for i, frame in enumerate(kept)], whole(12, mode, passes, speed=20)
    )
    assert paused.states.count(State.PAUSED) == 1
    assert_safe(paused.instrument)


@pytest.mark.parametrize("number", [6, 10, 16])
def test_frames_without_beam_are_taken_again_within_their_pass(number: int) -> None:
    """Of four passes of three views, the first is taken twice: frame 10 is of the second time."""
    paused, times = Paused(), list[float]()

    def lost(seen: int) -> None:
        times.append(paused.instrument.clock.now())
        if len(times) - 1 == number:
            paused.pause.no_beam("no beam", since=times[number - 2])

    paused.instrument.on_frame = lost
    script = [Choice.AGAIN, Choice.NEXT]
    run = paused.run(12, passes=4, speed=20, choose=Scripted(script))
    assert run.error is None and run.scan.missing == []
    assert {frame.replaces for frame in run.frames} - {-1} == {number - 1, number}
    kept = [frame for frame in run.frames if frame.index not in (number - 1, number)]
    expected = Paused().run(12, passes=4, speed=20, choose=Scripted(script)).frames
    assert_same([replace(frame, index=i, replaces=-1) for i, frame in enumerate(kept)], expected)


def test_lost_and_ignored_triggers_before_a_pause_are_named_and_those_after_it_are_taken() -> None:
    """Trigger 7 is lost; 10 and 11, on the way when the stage brakes, are exposed anew."""
    paused = Paused(Faults(lost={FIRST + 7})).at_frame(FIRST + 9)
    run = paused.run(24, speed=55)
    assert run.scan.missing == [FIRST + 7]
    assert run.views == [i for i in range(24) if i != 7]
    assert_true(run.frames)


@pytest.mark.parametrize(("abort", "kind"), [(False, ScanStopped), (True, ScanAborted)])
def test_a_paused_scan_can_be_stopped_and_aborted(abort: bool, kind: type[ScanStopped]) -> None:
    stop = StopRequest()
    paused = Paused(stop=stop).at_frame(FIRST + 4)
    paused.pause.resume = stop.abort if abort else stop.stop  # type: ignore[method-assign]
    run = paused.run(12, at=Place.BOTH)
    assert type(run.error) is kind
    assert run.views == list(range(5))
    assert [f.kind for f in run.frames][FIRST + 5 :] == []  # darks and flats were taken before
    assert_safe(paused.instrument, home=not abort)


def test_a_pause_asked_for_before_the_first_frame_is_kept() -> None:
    paused = Paused()
    paused.pause.pause()
    run = paused.run(12)
    assert run.error is None and paused.states[:3] == [State.DARKS, State.PAUSED, State.DARKS]
    assert_same(run.frames, whole(12))


class Moment(PauseRequest):
    """Scripted for when it is looked at for the `nth` time, and taken back before the next look."""

    def __init__(self, nth: int) -> None:
        super().__init__()
        self.left = nth

    @property
    def reason(self) -> str:
        self.left -= 1
        return "for a moment" if self.left == 0 else ""


def test_a_pause_taken_back_at_once_is_no_silent_camera() -> None:
    expected = whole(4, speed=20)
    for nth in range(1, 41):
        paused = Paused()
        paused.pause = Moment(nth)
        run = paused.run(4, speed=20)
        assert run.error is None, nth
        assert_same(run.frames, expected)
    assert cast(Moment, paused.pause).left > 0  # there were not so many looks


@pytest.mark.parametrize(
    ("cause", "asked_in_pause"), [(Cause.SPACE, 0), (Cause.BACKLOG, 0), (Cause.BEAM, 1), (None, 1)]
)
def test_a_shutter_moved_by_hand_stays_as_it_is_in_a_pause_for_the_disk(
    cause: Cause | None, asked_in_pause: int
) -> None:
    paused, asked = Paused(), list[tuple[str, State]]()

    def put(request: str) -> None:
        asked.append((request, paused.machine.state))
        paused.instrument.is_open = request.startswith("Open")
        if paused.machine.state is State.PAUSED and paused.pause.reason:
            paused.pause.resume()
            paused.pause.release(cause or Cause.SPACE)

    def wait() -> bool:
        if paused.machine.state is State.PAUSED and not asked_in_pause:
            paused.pause.release(cause or Cause.SPACE)
        return False

    hold = (lambda: paused.pause.hold(cause, "for a while")) if cause else paused.pause.pause
    paused.instrument.at = {FIRST + 4: hold}
    paused.instrument.devices = replace(paused.instrument.devices, shutter=ManualShutter(put))
    machine = paused.machine = StateMachine(lambda event: paused.states.append(event.data["state"]), State.PREPARING)
    supervision = Supervision(pause=paused.pause, wait_in_pause=wait, states=machine)
    run = Run(paused.instrument, paused.instrument.timeline(12, Mode.FLY, 1, Place.START, 30), None, supervision)
    assert run.error is None and paused.states.count(State.PAUSED) == 1
    assert [request for request, state in asked if state is State.PAUSED] == [
        "Close the beam shutter.", "Open the beam shutter."
    ][: 2 * asked_in_pause]  # fmt: skip
    assert_same(run.frames, whole(12))
