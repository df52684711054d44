"""Every stage: a stop or abort from another thread at any moment at the start of a move takes effect."""

from __future__ import annotations

import itertools
import math
import threading
from collections.abc import Callable

import pytest

from drivers.base.errors import DeviceError
from drivers.testing.stages.bench import LONG, SPEED
from simulators.wires.wire import register
from tests.drivers.stages.rig import NAMES, StageRig
from tests.drivers.stages.rigs import RigOf, every_stage
from tests.slow_cases import others_slow


class StopInBetween:
    """A cable on which another thread's stop comes in while the driver waits for an answer; also the clock of both:
    for the thread that stops, time stands until `begun` is set."""

    def __init__(self, rig: StageRig) -> None:
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


@pytest.mark.parametrize("begin", others_slow(["move", "search"]))
@pytest.mark.parametrize("hard", [False, True], ids=["stop", "abort"])
@every_stage
def test_a_stop_at_any_moment_of_a_moves_beginning_wins(rig_of: RigOf, hard: bool, begin: str) -> None:
    for at in itertools.count(1):
        rig = rig_of()
        tap = StopInBetween(rig)
        rig.url = register(next(NAMES), tap)
        stage = rig.open(clock=tap)
        stage.start_move(math.radians(50), math.radians(30))
        stage.wait(LONG)
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
                stage.wait(LONG)
        if begin == "search":
            stage.start_home()
            stage.wait(LONG)
        stage.start_move(math.radians(60), math.radians(30))
        assert math.degrees(stage.wait(LONG)) == pytest.approx(60.0)
        stage.close()
