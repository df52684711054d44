"""Every stage driver: figures that no stage has, other makers' controllers, a stop at any moment, a crash before it."""

from __future__ import annotations

import itertools
import math
import sys
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import pytest

from drivers.errors import DeviceError, DeviceRefused
from drivers.motion import start_move_by
from drivers.protocols import TriggerTrain
from simulators.serial_url import register
from simulators.transports import serve_pty
from tests.drivers.stages.rigs import NAMES, RIGS, AnyRig, every_stage

SPEED = math.radians(10)
SOON = 60.0
needs_pty = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals that pyserial opens")
RigOf = Callable[..., AnyRig]


# figures


@pytest.mark.parametrize(
    "figures",
    [
        {"counts_per_turn": 0},
        {"counts_per_turn": -90_000},
        {"max_speed": math.inf},
        {"max_speed": math.nan},
        {"max_speed": 0.0},
        {"max_speed": -1.0},
        {"max_speed": 1e300},
        {"acceleration": math.inf},
        {"acceleration": math.nan},
        {"acceleration": 0.0},
        {"low": math.nan},
        {"low": -math.inf},
        {"high": math.inf},
        {"high": 1e300},
        {"low": 2.0},
        {"timeout": 0.0},
        {"timeout": math.nan},
    ],
    ids=str,
)
@every_stage
def test_figures_that_no_stage_has_are_refused_before_anything_is_sent(rig_of: RigOf, figures: dict[str, Any]) -> None:
    rig = rig_of()
    heard: list[bytes] = []
    receive = rig.receive
    rig.receive = lambda data: (heard.append(data), receive(data))[1]  # type: ignore[method-assign]
    with pytest.raises(DeviceRefused, match="Nothing was sent"):
        rig.open(**figures)
    assert heard == []
    rig.open().close()


@pytest.mark.parametrize("angle", [1e12, 1e300, -1e300, sys.float_info.max])
@every_stage
def test_an_angle_beyond_all_numbers_is_refused_like_any_other(rig_of: RigOf, angle: float) -> None:
    stage = rig_of().open()
    with pytest.raises(DeviceRefused, match="Nothing has moved"):
        stage.start_move(angle, SPEED)
    assert not stage.moving()
    stage.close()


@pytest.mark.parametrize("speed", [1e300, sys.float_info.max, math.inf])
@every_stage
def test_a_speed_beyond_all_numbers_is_refused_like_any_other(rig_of: RigOf, speed: float) -> None:
    stage = rig_of().open()
    with pytest.raises(DeviceRefused, match="Nothing has moved"):
        stage.start_move(0.1, speed)
    assert not stage.moving()
    stage.close()


@pytest.mark.parametrize("angle", [1e12, -1e300, sys.float_info.max, math.nan])
@every_stage
def test_a_relative_move_beyond_all_numbers_is_refused_like_any_other(rig_of: RigOf, angle: float) -> None:
    stage = rig_of().open()
    with pytest.raises(DeviceRefused, match="Nothing has moved"):
        start_move_by(stage, angle, SPEED)
    assert not stage.moving()
    stage.close()


@pytest.mark.parametrize("counts", [5000, 36_000, 1 << 23, 100_000_000])
@every_stage
def test_a_count_is_a_count_whether_a_turn_has_few_or_many(rig_of: RigOf, counts: int) -> None:
    rig = rig_of(counts_per_turn=counts)
    fast = math.radians(300) * min(1.0, 1e6 / counts)
    without_home = {"home": None, "home_speed": None} if rig_of is RIGS["pm16c"] else {}
    bench = rig.bench(counts_per_turn=counts, max_speed=fast, acceleration=10 * fast, **without_home)
    stage = bench.stage
    for target in (1, 0, -1, counts // 16, counts // 16 + 1):
        stage.start_move(stage.to_angle(target), fast)
        assert stage.to_counts(stage.wait(SOON)) == target
        assert bench.line.angle_at(bench.clock.now()) == pytest.approx(stage.to_angle(target), rel=1e-12, abs=1e-15)
    first, interval = counts // 16 - counts // 100, -(counts // 200)
    stage.arm(TriggerTrain(first, interval, 3))
    stage.start_move(0.0, fast)
    stage.wait(SOON)
    found = [pulse.angle / (2 * math.pi) * counts for pulse in bench.pulses()]
    assert found == pytest.approx(
        [first, first + interval, first + 2 * interval], abs=0.2
    )  # the clock's float of today
    stage.close()


# somebody else's controller


@pytest.mark.parametrize("other", RIGS, ids=RIGS.keys())
@every_stage
def test_another_makers_controller_is_an_error_in_time_and_turns_nothing(rig_of: RigOf, other: str) -> None:
    if RIGS[other] is rig_of:
        pytest.skip("its own controller, which it must like")
    mine, theirs = rig_of(), RIGS[other]()
    mine.clock, mine.url = theirs.clock, theirs.url
    before = theirs.clock.now()
    with pytest.raises(DeviceError, match=r"Nothing (has moved|was sent)"):
        mine.open()
    assert theirs.clock.now() - before < 10.0
    theirs.clock.sleep(60.0)
    assert theirs.line.angle_at(theirs.clock.now()) == 0.0
    assert theirs.line.next_after(-math.inf) is None
    theirs.open().close()


@pytest.mark.parametrize("serve", [None, pytest.param(serve_pty, marks=needs_pty)], ids=["sim", "pty"])
@every_stage
def test_a_second_driver_does_not_get_the_port_and_does_not_disturb_the_first(
    rig_of: RigOf, serve: Callable[[Any], AbstractContextManager[str]] | None
) -> None:
    rig = rig_of()
    with nullcontext(rig.url) if serve is None else serve(rig) as rig.url:
        bench = rig.bench()
        bench.stage.arm(bench.train(1.0, 1.0, 3))
        with pytest.raises(DeviceError, match=r"does not open.*Nothing was sent"):
            rig.open()
        bench.go(10.0)
        assert len(bench.pulses()) == 3
        bench.stage.close()
        rig.open().close()


# a stop from another thread


class StopInBetween:
    """A cable on which another thread's stop comes in while the driver waits for an answer; also the clock of both:
    for the thread that stops, time stands until `begun` is set."""

    def __init__(self, rig: AnyRig) -> None:
        self.clock, self._rig, self._time = self, rig, rig.clock
        self.begun = threading.Event()
        self._mover, self._heard = threading.current_thread(), threading.Event()
        self._answers = self._at = 0
        self.stopping = threading.Thread()
        self.failed: list[BaseException] = []

    def at_answer(self, number: int, stop: Callable[[], None]) -> None:
        """The stop comes with the answer of that number, from 1 on, counted from now."""

        def run() -> None:
            try:
                stop()
            except BaseException as problem:
                self.failed.append(problem)

        self._answers, self._at, self.stopping = 0, number, threading.Thread(target=run)

    def receive(self, data: bytes) -> None:
        self._rig.receive(data)
        if threading.current_thread() is self.stopping:
            self._heard.set()

    def transmit(self) -> bytes:
        data = self._rig.transmit()
        if data and threading.current_thread() is self._mover:
            self._answers += 1
            if self._answers == self._at:
                self.stopping.start()
                assert self._heard.wait(10.0)
        return data

    def now(self) -> float:
        return self._time.now()

    def sleep(self, seconds: float) -> None:
        if threading.current_thread() is self.stopping:
            assert self.begun.wait(10.0)
        self._time.sleep(seconds)

    @property
    def came(self) -> bool:
        return self._answers >= self._at


@pytest.mark.parametrize("begin", ["move", "search"])
@pytest.mark.parametrize("hard", [False, True], ids=["stop", "abort"])
@every_stage
def test_a_stop_at_any_moment_of_a_moves_beginning_wins(rig_of: RigOf, hard: bool, begin: str) -> None:
    for at in itertools.count(1):
        rig = rig_of()
        tap = StopInBetween(rig)
        rig.url = register(next(NAMES), tap)
        stage = rig.open(clock=tap)
        stage.start_move(math.radians(50), math.radians(30))
        stage.wait(SOON)
        tap.at_answer(at, stage.abort if hard else stage.stop)
        begun = False
        try:
            if begin == "move":
                stage.start_move(math.radians(90), SPEED)
            else:
                stage.start_home()
            begun = True
        except DeviceError as error:
            assert "stop" in str(error)
        tap.begun.set()
        if not tap.came:
            assert begun
            assert at >= 3, "the stop never came in between"
            stage.close()
            return
        tap.stopping.join(10.0)
        assert not tap.stopping.is_alive()
        assert tap.failed == []
        rig.clock.sleep(3.0)  # longer than it takes to slow down
        assert not stage.moving(), f"it moves although it was stopped at answer {at}"
        where = rig.line.angle_at(rig.clock.now())
        assert abs(where - math.radians(50)) < math.radians(5)
        if begun:
            with pytest.raises(DeviceError, match="stopped short"):
                stage.wait(SOON)
        if begin == "search":
            stage.start_home()
            stage.wait(SOON)
        stage.start_move(math.radians(60), math.radians(30))
        assert math.degrees(stage.wait(SOON)) == pytest.approx(60.0)
        stage.close()


# the one before


@every_stage
def test_a_train_that_a_crashed_program_armed_gives_no_pulse(rig_of: RigOf) -> None:
    rig = rig_of()
    bench = rig.bench()
    bench.stage.arm(bench.train(1.0, 1.0, 5))
    rig.url = register(next(NAMES), rig)  # the program is gone, the controller is not
    bench = rig.bench()
    bench.go(20.0)
    assert bench.pulses() == []
    bench.stage.arm(bench.train(21.0, 1.0, 3))
    bench.go(30.0)
    assert len(bench.pulses()) == 3
    bench.stage.close()
