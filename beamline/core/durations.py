"""Durations: what operations take on this machine, measured once and kept on disk; the time that is left; and the
phases of a long work.

Operations are measured in processor time, which is the same on a busy machine; a time that follows is that of an idle
one.
"""

from __future__ import annotations

import json
import math
import platform
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from beamline.core.errors import DataError
from beamline.core.events import PhaseReached, Sink
from beamline.core.files import write_whole
from beamline.core.machine import processor, state_folder, usable_cores
from drivers.base.clock import Clock, SystemClock
from recon.base.work import Rate

DAYS = 30.0  # after which figures are measured anew: updates and other programs change what a machine does
_LAWS = 1  # to be raised where an operation in `recon.machine_speed` takes another size, or does something else


@dataclass
class MachineSpeed:
    """Rates of operations on this machine, as `recon.base.work.Rates`; a missing one is measured and kept.

    Figures of another processor, number of cores or threads, or version are not taken, nor those of more than 30 days
    ago. A disk that does not take them loses only time: the next program measures again.

    Attributes:
        path: of the file; None: in the folder of this user's state.
        now: clock of the measurement, the processor time of this process.
        today: s since 1970; figures older than DAYS are measured again.
        key: what the figures are of.
    """

    path: Path | None = None
    now: Callable[[], float] = time.process_time
    today: Callable[[], float] = time.time
    key: Mapping[str, Any] = field(default_factory=lambda: _this_machine())
    _rates: dict[str, Rate] | None = None

    def __call__(self, operation: str) -> Rate:
        if self._rates is None:
            self._rates, _ = self._kept()
        if operation not in self._rates:
            from recon.machine_speed import measured_rate  # which loads all methods

            self._rates[operation] = measured_rate(operation, self.now, self.key["threads"])
            self._keep()
        return self._rates[operation]

    @property
    def _file(self) -> Path:
        return self.path or state_folder() / "speed.json"

    def _kept(self) -> tuple[dict[str, Rate], float]:
        """The rates on disk, and when the oldest of them were measured; none: now."""
        with suppress(OSError, ValueError, TypeError, KeyError, AttributeError):  # none, or not whole
            kept = json.loads(self._file.read_text(encoding="utf-8"))
            rates = {str(name): Rate(*map(float, rate)) for name, rate in kept["rates"].items()}
            measured = float(kept["measured"])
            if kept["key"] == self.key and 0 <= self.today() - measured < DAYS * 86400:
                return rates, measured
        return {}, self.today()

    def _keep(self) -> None:
        with suppress(OSError, DataError):
            others, measured = self._kept()  # of programs that ran meanwhile
            kept = {"key": self.key, "measured": measured, "rates": {**others, **(self._rates or {})}}
            self._file.parent.mkdir(parents=True, exist_ok=True)
            write_whole(self._file, json.dumps(kept), replace=True)


def _this_machine() -> dict[str, Any]:
    import numba

    return {
        "laws": _LAWS,
        "processor": processor(),
        "cores": usable_cores(),
        "threads": int(numba.get_num_threads()),
        "numba": str(numba.__version__),
        "python": platform.python_version(),
    }


def seconds_left(done: float, total: float, spent: float) -> float | None:
    """Seconds left at the speed so far; None while nothing is done.

    Args:
        done, total: in any unit in which the work is even, such as s of a prediction.
        spent: s for what is done.
    """
    return max(total - done, 0.0) * spent / done if done > 0 and spent > 0 else None


_SAY_EVERY = 0.2  # s between events on the progress of a phase


class Phases:
    """Consecutive phases without gaps, so that their seconds add up to the time since the start.

    Args:
        sink: gets an event `progress` of the stage "phase" as each begins, and some on its progress.
        clock: for their times.

    Attributes:
        seconds: of each phase that has ended; the sum for a repeated phase.
    """

    def __init__(self, sink: Sink = lambda event: None, clock: Clock | None = None) -> None:
        self._sink, self._clock = sink, clock or SystemClock()
        self._name, self._counted, self._begun, self._said = "", "", self._clock.now(), -math.inf
        self.seconds: dict[str, float] = {}

    def enter(self, name: str, counted: str = "views") -> None:
        """End the last phase and begin this one; its progress counts up to `counted`."""
        self.end()
        self._name, self._counted, self._said = name, counted, -math.inf
        self._say(0, 0, None, None)

    def progress(self, n: int, total: int) -> None:
        """Report that n of `total` are done; n = 0 is not reported."""
        now = self._clock.now()
        if not n:
            return
        if now - self._said >= _SAY_EVERY or n == total:
            self._said = now
            spent = max(now - self._begun, 1e-9)
            self._say(n, total, n / spent, seconds_left(n, total, spent))

    def end(self) -> None:
        """End the last phase now."""
        now = self._clock.now()
        if self._name:
            self.seconds[self._name] = self.seconds.get(self._name, 0.0) + now - self._begun
            self._begun = now
        self._name = ""

    def _say(self, n: int, of: int, per_s: float | None, eta_s: float | None) -> None:
        self._sink(PhaseReached("phase", self._counted, self._name, n, of, per_s, eta_s, time=self._clock.now()))
