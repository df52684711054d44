"""Simulated PI GCS 2.0, an output line with a cable: its CTO settings, and the pulses of the current move.

In mode 0 (PositionDistance) it gives one pulse for each step of travel. If the start threshold lies below the stop
threshold, pulses begin only in the positive direction; if it lies above, only in the negative one. Equal thresholds
switch the window off. A move that reverses inside the window continues giving pulses at every step. They end beyond
either threshold (C-863, E-727 manuals).

A move is a closed form of time. Therefore all its pulses are put on the cable, with their exact times, as soon as the
move begins. A stop removes the pulses that are still to come.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Set
from dataclasses import dataclass, replace

from drivers.stages.pi_gcs.settings import PiFirstPulse
from simulators.devices.motion import TrapezoidMove
from simulators.devices.trigger_line import Pulse, TriggerLine

SLACK = 1e-6  # counts: largest error of a position because of the number of decimals on the wire


@dataclass(frozen=True)
class Window:
    """Settings of a line: step > 0 and thresholds in counts of the axis; `zero` is the count of its position 0."""

    step: float
    start: float
    stop: float
    zero: float = 0.0
    rule: PiFirstPulse = PiFirstPulse.AT_THRESHOLD

    @property
    def sign(self) -> int:
        """The direction in which pulses begin: +1, -1, or 0 if the window is off."""
        return (self.stop > self.start) - (self.stop < self.start)


@dataclass(frozen=True)
class TrainProgress:
    """State of a line: True if it is inside its window, and the last pulse (or the place where it would have been):
    anchor + index steps."""

    inside: bool = False
    anchor: float = 0.0
    index: int = 0


@dataclass(frozen=True)
class Crossing:
    """A position at which the line changes, and its state after the change."""

    position: float
    pulse: bool
    after: TrainProgress


def crossings(window: Window, progress: TrainProgress, begin: float, end: float) -> Iterator[Crossing]:
    """The changes on the straight way from `begin` (not included) to `end` (included), in order."""
    if begin == end:
        return
    sign, reach = (1 if end > begin else -1), abs(end - begin)

    def ahead(position: float) -> float:
        return sign * (position - begin)

    if not progress.inside:
        if sign != window.sign or ahead(window.stop) < 0 or ahead(window.start) > reach:
            return
        if ahead(window.start) > 0:
            progress = _entered(window, window.start, sign)
            if window.rule is PiFirstPulse.AT_THRESHOLD:
                yield Crossing(window.start, True, progress)
            else:
                yield Crossing(window.start, False, progress)
        else:  # the axis was inside when the line was switched on
            progress = _entered(window, begin, sign)
    edge = window.stop if sign == window.sign else window.start
    room = ahead(edge) if window.sign else math.inf
    while True:
        position = progress.anchor + (progress.index + sign) * window.step
        if ahead(position) > min(room, reach) + SLACK:
            break
        progress = replace(progress, index=progress.index + sign)
        yield Crossing(end if ahead(position) > reach else position, True, progress)
    if room < reach:
        yield Crossing(edge, False, TrainProgress())


def _entered(window: Window, position: float, sign: int) -> TrainProgress:
    if window.rule is not PiFirstPulse.GRID:
        return TrainProgress(True, position, 0)
    steps = (position - window.zero) / window.step
    nearest = math.ceil(sign * steps - SLACK / window.step)
    return TrainProgress(True, window.zero, sign * (nearest - 1))


@dataclass
class PiOutput:
    """The CTO settings of one output line, in the units of the wire, and TRO. Only mode 0 gives pulses."""

    axis: str = "1"
    mode: int = 0
    step: float = 0.1
    start: float = 0.0
    stop: float = 0.0
    polarity: int = 1
    on: bool = False


@dataclass(frozen=True)
class Firmware:
    """Properties that no command changes.

    Attributes:
        first_pulse: place of the first pulse. The manuals do not say it, so each possibility is offered. width:
            duration of a pulse in s. period: duration of a servo cycle in s; positions are compared once per cycle. 0:
            positions are compared at every instant. lost: pulses that never reach the cable, counted from 0 since
            power-on. rising: True: the camera at the end of the cable reacts to rising edges; False: to falling edges.
    """

    first_pulse: PiFirstPulse
    width: float
    period: float
    lost: Set[int]
    rising: bool = True


@dataclass(frozen=True)
class _Coming:
    """A change of the line at `time` if the move is not stopped, and the edge that the camera gets; None if it gets no
    edge."""

    time: float
    crossing: Crossing
    edge: Pulse | None


class WiredOutput:
    """The line that the camera's cable is in. Positions are true counts.

    Args:
        per_degree: counts.
    """

    def __init__(self, settings: PiOutput, line: TriggerLine, firmware: Firmware, per_degree: float) -> None:
        self.settings = settings
        self._line, self._firmware, self._per_degree = line, firmware, per_degree
        self._progress, self._coming = TrainProgress(), list[_Coming]()
        self._done_until, self._zero = 0.0, 0.0
        self._high_until, self._pulses = -math.inf, 0

    def switch(self, on: bool, move: TrapezoidMove, zero: int, now: float) -> None:
        """TRO: switch the output on or off. `zero` is the count of the axis' position 0."""
        owed = self._settle(now)
        self.settings.on, self._zero = on, zero
        self._done_until = move.position(now)
        self._progress = TrainProgress() if self._window().sign else TrainProgress(True, self._done_until, 0)
        self._schedule(move, now, owed)

    def begin(self, move: TrapezoidMove, zero: int, now: float) -> None:
        owed = self._settle(now)
        self._done_until, self._zero = move.start, zero
        self._schedule(move, now, owed)

    def cut(self, move: TrapezoidMove, now: float) -> None:
        """Give the move in progress another end."""
        self._schedule(move, now, self._settle(now))

    def _window(self) -> Window:
        settings, scale = self.settings, self._per_degree
        start, stop = settings.start * scale + self._zero, settings.stop * scale + self._zero
        return Window(settings.step * scale, start, stop, self._zero, self._firmware.first_pulse)

    def _settle(self, now: float) -> list[Pulse]:
        """Keep past changes and drop future ones; returns the edges to come of pulses that have begun."""
        done = [coming for coming in self._coming if coming.time <= now]
        self._coming = []
        for coming in done:
            self._progress, self._done_until = coming.crossing.after, coming.crossing.position
            if coming.crossing.pulse:
                self._pulses, self._high_until = self._pulses + 1, coming.time + self._firmware.width
        return [coming.edge for coming in done if coming.edge is not None and coming.edge.time > now]

    def _schedule(self, move: TrapezoidMove, now: float, owed: list[Pulse]) -> None:
        self._line.cancel_after(now)
        ahead = move.direction * (move.target - self._done_until) > 0 and now < move.end
        if self.settings.on and self.settings.mode == 0 and ahead:
            self._foresee(move, now)
        self._line.schedule([*owed, *(coming.edge for coming in self._coming if coming.edge is not None)])

    def _foresee(self, move: TrapezoidMove, now: float) -> None:
        """A pulse that begins while the last is held gives no edge.

        If the pulses have the opposite polarity of the camera's, its edge is the end of a pulse.
        """
        number, high_until, firmware = self._pulses, self._high_until, self._firmware
        for crossing in crossings(self._window(), self._progress, self._done_until, float(move.target)):
            time, edge = self._noticed(move.time_at(crossing.position), now), None
            if crossing.pulse:
                if time > high_until and number not in firmware.lost:
                    edge_time = time if bool(self.settings.polarity) is firmware.rising else time + firmware.width
                    edge = Pulse(edge_time, move.position(edge_time) * 2 * math.pi / (360.0 * self._per_degree))
                high_until, number = time + firmware.width, number + 1
            self._coming.append(_Coming(time, crossing, edge))

    def _noticed(self, time: float, now: float) -> float:
        """Time at which the servo sees a crossing; never before the present time."""
        period = self._firmware.period
        return max(math.ceil(time / period) * period if period else time, math.nextafter(now, math.inf))
