"""Beam log: reads the beam monitor periodically while frames are taken, in its own thread; the scan never waits."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from typing import Self

from beamline.config.beam import NoBeamMonitor
from beamline.config.devices import BeamMonitorConfig
from beamline.core.events import BeamRead, Sink, Warned
from beamline.core.stop import PauseRequest
from beamline.core.text import count
from beamline.scan.supervision import PAUSE_POLL, BeamGuard, BeamLimits
from drivers.base.errors import DeviceError
from drivers.base.protocols import BeamMonitor, BeamReading

LAST_WAIT = 3.0  # Longest wait in s for a reading in progress at the end of a scan


class BeamLog:
    """Use as a context manager. Each reading is an event `beam`; failing readings are one warning until one succeeds.

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
        """If readings are acted on: wait for one that begins after this call, or until `stop` returns True."""
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
        self._failed += 1
        if self._failed > 1 or self._over.is_set():
            return
        problem = str(error) if isinstance(error, DeviceError) else f"{name}: {type(error).__name__}: {error}."
        self._sink(Warned(f"{problem} The scan goes on without readings until it answers again."))


def beam_log(config: BeamMonitorConfig, monitor: BeamMonitor | None, sink: Sink, pause: PauseRequest) -> BeamLog:
    """The log of the configured beam monitor, which pauses the scan where that is configured."""
    if isinstance(config, NoBeamMonitor):
        return BeamLog(None, math.inf, sink)
    guard = None
    if config.pause_below is not None:
        guard = BeamGuard(BeamLimits(config.pause_below, config.resumes_at, config.settle_s), pause)
    return BeamLog(monitor, config.period_s, sink, guard)
