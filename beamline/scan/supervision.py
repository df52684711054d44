"""Supervision: callbacks from an acquisition to the scan around it; and the beam monitor, whose readings may pause the
scan.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Self

from beamline.config.beam import NoBeamMonitor
from beamline.config.devices import BeamMonitorConfig
from beamline.core.events import BeamRead, Sink, Warned
from beamline.core.stop import Cause, PauseRequest
from beamline.core.text import count
from beamline.plan.passes import Choice, Passes
from beamline.plan.plan import Block, Retake
from beamline.scan.control import State, StateMachine
from drivers.base.errors import DeviceError
from drivers.base.frame import Frame
from drivers.base.protocols import BeamMonitor, BeamReading

PAUSE_POLL = 0.05  # real s between checks of a paused scan


def _wait_in_pause() -> bool:
    time.sleep(PAUSE_POLL)
    return False


@dataclass(frozen=True)
class Supervision:
    """Callbacks of the acquisition that pause a scan."""

    # refusal: called once before the first projection, when all earlier frames are recorded. Returns the reason why no
    # projection should be taken; None: projections may be taken
    refusal: Callable[[], str | None] = lambda: None
    # pause: checked before each frame if the stage is at rest, and continuously while the stage turns
    pause: PauseRequest = field(default_factory=PauseRequest)
    # wait_in_pause: called repeatedly while the scan is paused. It waits a moment, and returns whether the operator at
    # the terminal has ended the pause
    wait_in_pause: Callable[[], bool] = _wait_in_pause
    # states: gets each new state of the scan
    states: StateMachine = field(default_factory=lambda: StateMachine(state=State.PREPARING))
    # retakes: called with the triggers without a frame, after the last projection, and when retakes were chosen.
    # Returns the projections that are repeated now
    retakes: Callable[[Sequence[int]], Sequence[Retake]] = lambda missing: ()
    # wait_for_beam_reading: called after the last frame of flats and of projections. Returns as soon as it is known
    # whether there was beam
    wait_for_beam_reading: Callable[[], None] = lambda: None
    # next_pass: called after each pass of projections, offset projections or retakes, if something is left to measure.
    # Returns a possible choice; None: nothing is chosen. It may take long and close the shutter; the next frames open
    # the shutter again
    next_pass: Callable[[Passes], Choice] | None = None
    # pass_ended: called before `next_pass`, and also after the last pass, when all frames were delivered
    pass_ended: Callable[[], None] = lambda: None
    # n_retakable: called before `next_pass` with the triggers without a frame. Returns how many projections `retakes`
    # would return
    n_retakable: Callable[[Sequence[int]], int] = lambda missing: 0
    # turn: called before anything moves. Returns when the scan may begin
    turn: Callable[[], None] = lambda: None
    # recorded: returns frames that another scan has taken, for a block of darks or flats; empty: this scan takes its
    # own frames
    recorded: Callable[[Block], Sequence[Frame]] = lambda block: ()


class BeamGuard:
    """Pauses a scan as long as the beam monitor reads too little beam.

    Args:
        pause_below: the scan pauses if a reading is below this value (in the unit of the monitor). resume_above: a
            reading of at least this value means that the beam is back.
        settle: time in s for which readings must stay above this value before the scan continues.
    """

    def __init__(self, pause_below: float, resume_above: float, settle: float, pause: PauseRequest) -> None:
        self._pause_below, self._resume_above, self._settle, self._pause = pause_below, resume_above, settle, pause
        self._last_good_time = -math.inf
        """Time of the last reading with beam."""
        self._beam_back_since: float | None = None
        """During a pause: the time since which the beam is back."""
        self._paused = False

    def __call__(self, reading: BeamReading) -> None:
        """Process the next reading: pause or continue the scan if necessary."""
        if not self._paused:
            if reading.value >= self._pause_below:
                self._last_good_time = reading.time
                return
            self._paused = True
            self._pause.no_beam(
                f"the beam monitor reads {reading.value:.4g} {reading.unit}, less than "
                f"{self._pause_below:.4g}. The scan continues automatically after the reading has been at "
                f"least {self._resume_above:.4g} for {self._settle:g} s",
                self._last_good_time,
            )
        if reading.value < self._resume_above:
            self._beam_back_since = None
            return
        self._beam_back_since = reading.time if self._beam_back_since is None else self._beam_back_since
        if reading.time - self._beam_back_since >= self._settle:
            self._paused, self._beam_back_since, self._last_good_time = False, None, reading.time
            self._pause.release(Cause.BEAM)


LAST_WAIT = 3.0  # Longest wait in s, at the end of a scan, for a reading that is in progress


class BeamLog:
    """Context manager that logs the readings of the beam monitor. Each reading is an event `beam`. Consecutive failed
    readings give one warning.

    Args:
        monitor: the beam monitor; None: nothing is read. period: real time in s between readings. sink: receives the
            events `beam` and `warning`, in the thread of the log. react: function that gets each reading. If it is
            given, the first reading is taken before the context is entered.
    """

    def __init__(
        self, monitor: BeamMonitor | None, period: float, sink: Sink, react: Callable[[BeamReading], None] | None = None
    ) -> None:
        self._monitor, self._period, self._sink, self._react = monitor, period, sink, react
        self._readings: list[BeamReading] = []
        self._n_failed = 0  # number of consecutive failed readings
        self._n_begun = self._n_ended = 0  # number of readings
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="beam log", daemon=True)

    @property
    def readings(self) -> tuple[BeamReading, ...]:
        """The readings so far, oldest first."""
        return tuple(self._readings)

    def wait_for_reading(self, stop: Callable[[], bool]) -> None:
        """If readings control the scan, wait for a reading that begins after this call, or until `stop` returns
        True."""
        due = self._n_begun + 1
        while self._react is not None and self._n_ended < due and self._thread.is_alive() and not stop():
            time.sleep(PAUSE_POLL)

    def __enter__(self) -> Self:
        if self._monitor is not None:
            if self._react is not None:
                self._read(self._monitor)
            self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        if self._thread.is_alive():
            self._thread.join(LAST_WAIT)

    def _run(self) -> None:
        assert self._monitor is not None
        while not self._over.is_set():
            self._read(self._monitor)
            self._over.wait(self._period)

    def _read(self, monitor: BeamMonitor) -> None:
        self._n_begun += 1
        try:
            reading = monitor.reading()
        except BaseException as error:  # a failure of the beam monitor never ends the scan
            self._fail(monitor.name, error)
        else:
            self._enter(monitor.name, reading)
        self._n_ended = self._n_begun

    def _enter(self, name: str, reading: BeamReading) -> None:
        if self._over.is_set():  # this reading comes too late to be written
            return
        if self._n_failed:
            self._sink(Warned(f"{name}: it answers again after {count(self._n_failed, 'failed reading')}."))
            self._n_failed = 0
        self._readings.append(reading)
        self._sink(BeamRead(reading.value, reading.unit, reading.time))
        if self._react is not None:
            self._react(reading)

    def _fail(self, name: str, error: BaseException) -> None:
        self._n_failed += 1  # only a warning, because a failing beam monitor never stops a scan
        if self._n_failed > 1 or self._over.is_set():
            return
        problem = str(error) if isinstance(error, DeviceError) else f"{name}: {type(error).__name__}: {error}."
        self._sink(Warned(f"{problem} The scan continues without readings until the monitor answers again."))


def beam_log(config: BeamMonitorConfig, monitor: BeamMonitor | None, sink: Sink, pause: PauseRequest) -> BeamLog:
    """The log of the configured beam monitor. If pause_below is set, it pauses the scan."""
    if isinstance(config, NoBeamMonitor):
        return BeamLog(None, math.inf, sink)
    guard = None
    if config.pause_below is not None:
        guard = BeamGuard(config.pause_below, config.resumes_at, config.settle_s, pause)
    return BeamLog(monitor, config.period_s, sink, guard)
