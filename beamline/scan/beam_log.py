"""Beam log: reads the beam monitor periodically while frames are taken, in its own thread; the scan never waits."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import TracebackType
from typing import Self

from beamline.core.events import BeamRead, Sink, Warned
from drivers.base.errors import DeviceError
from drivers.base.protocols import BeamMonitor, BeamReading

LAST_WAIT = 3.0
"""Longest wait in s for a reading in progress at the end of a scan."""


class BeamLog:
    """Use as a context manager. Each reading is an event `beam`; failing readings are one warning until one succeeds.

    Args:
        monitor: None: nothing is read.
        period: s of real time between readings.
        sink: takes (event, data) of `beam` and `warning`, called in the log's thread.
        react: told each reading. Then the first one is taken before the context is entered.
    """

    def __init__(
        self,
        monitor: BeamMonitor | None,
        period: float,
        sink: Sink,
        react: Callable[[BeamReading], None] | None = None,
    ) -> None:
        self._monitor, self._period, self._sink, self._react = monitor, period, sink, react
        self._readings: list[BeamReading] = []
        self._failed = 0  # failed readings in a row
        self._begun = self._ended = 0  # readings
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="beam log", daemon=True)

    @property
    def readings(self) -> tuple[BeamReading, ...]:
        """The readings so far, in order of time."""
        return tuple(self._readings)

    def next_reading_done(self) -> Callable[[], bool]:
        """Returns a function: whether a reading begun after this call is over (or failed), or no reading will come."""
        due = self._begun + 1
        return lambda: self._ended >= due or not self._thread.is_alive()

    def __enter__(self) -> Self:
        if self._monitor is not None:
            if self._react is not None:
                self._read(self._monitor)
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
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
        except Exception as error:  # no failure of the beam monitor ends the scan
            self._fail(monitor.name, error)
        else:
            self._enter(monitor.name, reading)
        self._ended = self._begun

    def _enter(self, name: str, reading: BeamReading) -> None:
        if self._over.is_set():  # too late to be written
            return
        if self._failed:
            failed = "1 failed reading" if self._failed == 1 else f"{self._failed} failed readings"
            self._sink(Warned(f"{name}: it answers again after {failed}."))
            self._failed = 0
        self._readings.append(reading)
        self._sink(BeamRead(reading.value, reading.unit, reading.time))
        if self._react is not None:
            self._react(reading)

    def _fail(self, name: str, error: Exception) -> None:
        self._failed += 1
        if self._failed > 1 or self._over.is_set():
            return
        problem = str(error) if isinstance(error, DeviceError) else f"{name}: {type(error).__name__}: {error}."
        self._sink(Warned(f"{problem} The scan goes on without readings until it answers again."))
