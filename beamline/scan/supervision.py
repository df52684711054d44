"""Supervision: causes that pause or end a scan: beam monitor, as its log reads it, and alarms of frames."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Self

from beamline.config.beam import NoBeamMonitor
from beamline.config.devices import BeamMonitorConfig
from beamline.core.events import BeamRead, Sink, Warned
from beamline.core.stop import Cause, PauseRequest, StopRequest
from beamline.core.text import count, size
from beamline.monitor.check import Flag, Level, Policy
from beamline.plan.passes import Choice, Passes
from beamline.plan.plan import Retake
from beamline.scan.control import State, StateMachine
from drivers.base.errors import DeviceError
from drivers.base.protocols import BeamMonitor, BeamReading

CLOSING = 20_000_000  # bytes that a file may take to be closed, with its /exchange view
PAUSE_POLL = 0.05  # real s between checks of a paused scan


def _wait_in_pause() -> bool:
    time.sleep(PAUSE_POLL)
    return False


@dataclass(frozen=True)
class Supervision:
    """Callbacks of the acquisition that pause a scan."""

    # refusal: called once, before the first projection, when all earlier frames are recorded. Returns why no projection
    # should be taken; None: projections may be taken
    refusal: Callable[[], str | None] = lambda: None
    # pause: checked before each frame of a standing stage, and all the time while it turns
    pause: PauseRequest = field(default_factory=PauseRequest)
    # wait_in_pause: called repeatedly while the scan is paused. It waits a moment, and returns whether the operator at
    # the terminal has let the scan go on
    wait_in_pause: Callable[[], bool] = _wait_in_pause
    # states: told the states of the scan
    states: StateMachine = field(default_factory=lambda: StateMachine(state=State.PREPARING))
    # retakes: called with the triggers without a frame, after the last projection and where retakes were chosen;
    # returns the views that are repeated now
    retakes: Callable[[Sequence[int]], Sequence[Retake]] = lambda missing: ()
    # wait_for_beam_reading: called after the last frame of flats and views: returns when it is known whether there was
    # beam
    wait_for_beam_reading: Callable[[], None] = lambda: None
    # next_pass: called after each pass of views, wide views or retakes, if something is left, and returns a choice that
    # is possible. It may take its time, and close the shutter, which the next frames open. None: nothing is chosen
    next_pass: Callable[[Passes], Choice] | None = None
    # pass_ended: called before `next_pass`, and after the last pass, too; all frames were delivered
    pass_ended: Callable[[], None] = lambda: None
    # n_retakable: called before `next_pass` with the triggers without a frame; how many views `retakes` would return
    n_retakable: Callable[[Sequence[int]], int] = lambda missing: 0


@dataclass(frozen=True)
class BeamLimits:
    """Beam intensities at which a scan pauses and resumes, in the beam monitor's unit."""

    pause_below: float  # a reading below it pauses the scan
    resume_above: float  # readings of at least so much mean that the beam is back
    settle: float  # s for which they must be so, before the scan goes on


class BeamGuard:
    """Pauses a scan while the beam monitor reads too little beam."""

    def __init__(self, limits: BeamLimits, pause: PauseRequest) -> None:
        self._limits, self._pause = limits, pause
        self._good = -math.inf
        """Time of the last reading with beam."""
        self._back: float | None = None
        """While paused: the time since which the beam is back."""
        self._paused = False

    def __call__(self, reading: BeamReading) -> None:
        """Record the next reading, and act."""
        limits = self._limits
        if not self._paused:
            if reading.value >= limits.pause_below:
                self._good = reading.time
                return
            self._paused = True
            self._pause.no_beam(
                f"the beam monitor reads {reading.value:.4g} {reading.unit}, less than {limits.pause_below:.4g}. The "
                f"scan goes on by itself when it has read {limits.resume_above:.4g} again for {limits.settle:g} s",
                self._good,
            )
        if reading.value < limits.resume_above:
            self._back = None
            return
        self._back = reading.time if self._back is None else self._back
        if reading.time - self._back >= limits.settle:
            self._paused, self._back, self._good = False, None, reading.time
            self._pause.release(Cause.BEAM)


class SpaceGuard:
    """Pauses a scan before its disk is full, until twice the limit is free.

    Args:
        reserve: bytes that must stay free for the frames that still come when the scan is to pause.
    """

    def __init__(self, reserve: int, pause: PauseRequest) -> None:
        self._reserve, self._pause = reserve, pause

    def __call__(self, free: int, left: int) -> None:
        """Record the free bytes and the bytes that are still to be written."""
        again = min(2 * self._reserve, left) + CLOSING
        if left and free < min(self._reserve, left) + CLOSING:
            self._pause.hold(
                Cause.SPACE,
                f"{size(free)} are free on the scan's disk, and {size(left)} are still to come. Free some: at "
                f"{size(again)} the scan goes on by itself",
            )
        elif not left or free >= again:
            self._pause.release(Cause.SPACE)


@dataclass
class Workload:
    """Busy seconds of a recorder's threads: checking frames, and writing them."""

    checking: float = 0.0
    writing: float = 0.0

    @property
    def behind(self) -> tuple[str, str]:
        """The cause of the backlog, and a remedy: the disk if writing took longer than the checks."""
        if self.writing > self.checking:
            return "the disk is behind", "a longer period_s or a faster disk"
        return "the processor is behind", "a longer period_s, no live reconstruction or fewer programs beside it"


class BacklogGuard:
    """Pauses a fly scan before the queue is full, until few frames wait to be written.

    Args:
        room: frames that may wait.
        work: the time that earlier frames took.
    """

    def __init__(self, room: int, pause: PauseRequest, work: Workload) -> None:
        self._room, self._pause, self._work = room, pause, work

    def __call__(self, waiting: int) -> None:
        """Record the number of waiting frames."""
        if 4 * waiting >= 3 * self._room:
            what, advice = self._work.behind
            self._pause.hold(
                Cause.BACKLOG,
                f"{what}, {waiting} of at most {self._room} frames wait in memory. The scan goes on by "
                f"itself when most of them are written; {advice} spares the pauses",
            )
        elif 4 * waiting <= self._room:
            self._pause.release(Cause.BACKLOG)


class AlarmReaction:
    """What the monitor's alarms do to a scan.

    Args:
        act_after: frames in a row with an alarm of a check, after which its policy is carried out; again after so many.
        policies: by the name of the check.
    """

    def __init__(
        self, act_after: int, policies: Mapping[str, Policy], stop: StopRequest, pause: PauseRequest, sink: Sink
    ) -> None:
        self._act_after, self._policies = act_after, policies
        self._stop, self._pause, self._sink = stop, pause, sink
        self._in_a_row: Counter[str] = Counter()

    def __call__(self, flags: tuple[Flag, ...]) -> None:
        """Record the flags of the next frame, and act."""
        alarms = [flag for flag in flags if flag.level is Level.ALARM]
        self._in_a_row = Counter({flag.check: self._in_a_row[flag.check] + 1 for flag in alarms})
        for flag in alarms:
            if self._in_a_row[flag.check] % self._act_after == 0:
                self._act(flag)

    def _act(self, flag: Flag) -> None:
        n = self._in_a_row[flag.check]
        frames = f"{n} frames in a row have" if n > 1 else "1 frame has"
        reason = f"{frames} an alarm of the monitor's {flag.check} check: {flag.advice.rstrip('.')}"
        match self._policies.get(flag.check, Policy.LOG):
            case Policy.WARN:
                self._sink(Warned(f"{reason}."))
            case Policy.PAUSE:
                self._pause.pause(reason)
            case Policy.STOP if not self._stop.stopping:
                self._stop.stop(reason, by_itself=True)


LAST_WAIT = 3.0  # Longest wait in s for a reading in progress at the end of a scan


class BeamLog:
    """Context manager that logs the beam. Each reading is an event `beam`; consecutive failed readings give one
    warning.

    Args:
        monitor: None: nothing is read.
        period: s of real time between readings.
        sink: takes (event, data) of `beam` and `warning`, called in the log's thread.
        react: told each reading. Then the first one is taken before the context is entered.
    """

    def __init__(
        self, monitor: BeamMonitor | None, period: float, sink: Sink, react: Callable[[BeamReading], None] | None = None
    ) -> None:
        self._monitor, self._period, self._sink, self._react = monitor, period, sink, react
        self._readings: list[BeamReading] = []
        self._failed = 0  # failed readings in a row
        self._begun = self._ended = 0  # readings
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="beam log", daemon=True)

    @property
    def readings(self) -> tuple[BeamReading, ...]:
        """The readings so far, oldest first."""
        return tuple(self._readings)

    def wait_for_reading(self, stop: Callable[[], bool]) -> None:
        """If readings control the scan, wait for one that begins after this call, or until `stop` returns True."""
        due = self._begun + 1
        while self._react is not None and self._ended < due and self._thread.is_alive() and not stop():
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
        self._begun += 1
        try:
            reading = monitor.reading()
        except BaseException as error:  # no failure of the beam monitor ends the scan
            self._fail(monitor.name, error)
        else:
            self._enter(monitor.name, reading)
        self._ended = self._begun

    def _enter(self, name: str, reading: BeamReading) -> None:
        if self._over.is_set():  # too late to be written
            return
        if self._failed:
            self._sink(Warned(f"{name}: it answers again after {count(self._failed, 'failed reading')}."))
            self._failed = 0
        self._readings.append(reading)
        self._sink(BeamRead(reading.value, reading.unit, reading.time))
        if self._react is not None:
            self._react(reading)

    def _fail(self, name: str, error: BaseException) -> None:
        self._failed += 1  # and nothing else: a failing beam monitor never stops a scan
        if self._failed > 1 or self._over.is_set():
            return
        problem = str(error) if isinstance(error, DeviceError) else f"{name}: {type(error).__name__}: {error}."
        self._sink(Warned(f"{problem} The scan continues without readings until the monitor answers again."))


def beam_log(config: BeamMonitorConfig, monitor: BeamMonitor | None, sink: Sink, pause: PauseRequest) -> BeamLog:
    """The log of the configured beam monitor, which pauses the scan if so configured."""
    if isinstance(config, NoBeamMonitor):
        return BeamLog(None, math.inf, sink)
    guard = None
    if config.pause_below is not None:
        guard = BeamGuard(BeamLimits(config.pause_below, config.resumes_at, config.settle_s), pause)
    return BeamLog(monitor, config.period_s, sink, guard)
