"""Beam log: the beam monitor read at a set period while frames are taken, in a thread that no scan ever waits for."""

from __future__ import annotations

import threading
from types import TracebackType
from typing import Self

from beamline.core.events import Emit
from drivers.errors import DeviceError
from drivers.protocols import BeamMonitor, BeamReading

LAST_WAIT = 3.0
"""s that the end of a scan waits for a reading under way."""


class BeamLog:
    """Use as a context manager. Each reading is an event `beam`; a monitor that fails is told once until it answers.

    Args:
        monitor: None: nothing is read.
        period: s of real time between readings.
        emit: takes (event, data) for beam and warning, from the log's own thread.
    """

    def __init__(self, monitor: BeamMonitor | None, period: float, emit: Emit) -> None:
        self._monitor, self._period, self._emit = monitor, period, emit
        self._readings: list[BeamReading] = []
        self._failed = 0  # readings in a row
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="beam log", daemon=True)

    @property
    def readings(self) -> tuple[BeamReading, ...]:
        """So far, in the order of time."""
        return tuple(self._readings)

    def __enter__(self) -> Self:
        if self._monitor is not None:
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
            try:
                reading = self._monitor.reading()
            except Exception as error:  # whatever is wrong with it, the scan goes on
                self._fail(self._monitor.name, error)
            else:
                self._enter(self._monitor.name, reading)
            self._over.wait(self._period)

    def _enter(self, name: str, reading: BeamReading) -> None:
        if self._over.is_set():  # it came too late to be written
            return
        if self._failed:
            failed = "1 reading" if self._failed == 1 else f"{self._failed} readings"
            self._emit("warning", {"message": f"{name}: it answers again, after {failed} that failed."})
            self._failed = 0
        self._readings.append(reading)
        self._emit("beam", {"value": reading.value, "unit": reading.unit, "read_at": reading.time})

    def _fail(self, name: str, error: Exception) -> None:
        self._failed += 1
        if self._failed > 1 or self._over.is_set():
            return
        said = str(error) if isinstance(error, DeviceError) else f"{name}: {type(error).__name__}: {error}."
        self._emit("warning", {"message": f"{said} The scan goes on; this is said once until it answers again."})
