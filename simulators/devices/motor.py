"""Pulse motor: one axis that counts commanded pulses, with limits, stops and a position-synchronised trigger output.

Nothing runs in the background, because a move is a closed form of time. When a move starts, its trigger pulses are put
on the line with their exact times. A stop removes the pulses that are still in the future.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Set
from dataclasses import dataclass
from enum import IntFlag

from drivers.base.clock import Clock
from simulators.devices.motion import MovedAxis, TrapezoidMove
from simulators.devices.trigger_line import Pulse, TriggerLine


class Ended(IntFlag):
    """The reason why the last move ended early; the values are status bits of the PM16C."""

    LIMIT = 0x20
    SLOW_STOP = 0x40
    EMERGENCY = 0x80


@dataclass(frozen=True)
class TriggerSettings:
    """Pulses of `width` s at the counts start, start + interval, ... up to end. If end < start, the motor turns the
    other way. Without a width the output is off."""

    width: float | None = 1e-3
    start: int = 1000
    end: int = 10_000
    interval: int = 200

    @property
    def sign(self) -> int:
        return -1 if self.end < self.start else 1

    @property
    def points(self) -> range:
        return range(self.start, self.end + self.sign, self.sign * self.interval)


class MotorOutput:
    """The counter of a trigger output. After it is armed, each point fires once when the axis passes it forwards.

    After a stop between points, the remaining points fire when the move continues. Points that have fired do not fire
    again if the axis moves back over them. A pulse that begins while the last one is still high gives no edge. So the
    output stays high if the width is at least the time of one interval.

    Args:
        lost: pulses that never reach the line, counted from 0 since power-on. fires_at_start: True: the start point
            itself is one of the points.
    """

    def __init__(self, lost: Set[int], fires_at_start: bool = True) -> None:
        self.settings = TriggerSettings()
        self._lost, self._first = lost, 0 if fires_at_start else 1
        self._armed = False
        self._fired = 0
        self._fired_before = 0
        self._last_fired = -math.inf
        self._coming: list[float] = []

    def can_arm(self, position: int) -> bool:
        """True if the output is on, and the axis is at a `position` before the start point."""
        return self.settings.width is not None and self.settings.sign * (self.settings.start - position) > 0

    def arm(self) -> None:
        self.clear()
        self._armed = True

    def clear(self) -> None:
        self._fired_before += self._fired
        self._fired, self._coming, self._armed = 0, [], False

    def ready(self, now: float) -> bool:
        """True if the output waits for its start point."""
        self.settle(now)
        return self._armed and self._fired == 0

    def settle(self, now: float) -> None:
        """Count all passed points as fired."""
        fired = [time for time in self._coming if time <= now]
        self._fired += len(fired)
        self._last_fired = max(fired, default=self._last_fired)
        self._coming = self._coming[len(fired) :]

    def follow(self, move: TrapezoidMove, now: float) -> list[tuple[float, int]]:
        """(time, count) of the edges that `move` causes from `now` on; they replace earlier predictions."""
        self.settle(now)
        self._coming = []
        width = self.settings.width
        if not self._armed or width is None or move.direction != self.settings.sign:
            return []
        edges, high_until = [], self._last_fired + width
        points = self.settings.points[self._first :]
        for index, point in enumerate(points[self._fired :], self._fired):
            arrival = _arrival(move, point)
            if arrival is None:
                break
            time = max(arrival, math.nextafter(now, math.inf))  # this edge has not fired yet, so it is still to come
            if time > high_until and self._fired_before + index not in self._lost:
                edges.append((time, point))
            high_until = time + width
            self._coming.append(time)
        return edges


def _arrival(move: TrapezoidMove, position: int) -> float | None:
    """Time at which a move arrives at `position`; None if the move does not arrive there, or starts there."""
    low, high = sorted((move.start, move.target))
    return move.time_at(position) if low <= position <= high and position != move.start else None


class PulseMotor(MovedAxis):
    """One axis. `line()` returns the cable of its trigger output, or None without a cable.

    Args:
        counts_per_turn: number of pulses for 2π of true angle. lost: trigger pulses that never reach the line, counted
            from 0 since power-on.
        stall_at: a move that would pass this count stops there at once (EMERGENCY), as by an interlock.
        switch_at: a move that would pass this count stops there at once (LIMIT), as by a limit switch.
        fires_at_start: True: the start point of a train itself gives a pulse.

    `stall_at` and `switch_at` may be changed while the axis is at rest, as if a person removes an obstacle.
    """

    def __init__(
        self,
        clock: Clock,
        line: Callable[[], TriggerLine | None],
        *,
        counts_per_turn: int,
        lost: Set[int] = frozenset(),
        stall_at: int | None = None,
        switch_at: int | None = None,
        fires_at_start: bool = True,
    ) -> None:
        super().__init__(clock.now(), 0.0, counts_per_turn)
        self.stall_at, self.switch_at = stall_at, switch_at
        self.trigger = MotorOutput(lost, fires_at_start)
        self.limits: tuple[int, int] | None = None
        self.ended = Ended(0)
        self._clock, self._line = clock, line

    def moving(self) -> bool:
        return self._clock.now() < self.move.end

    def position(self) -> int:
        """The signed number of pulses so far."""
        return self.move.counts(self._clock.now())

    def preset(self, count: int) -> None:
        """Set the count of the present position to `count`; the motor does not move."""
        now, here = self._clock.now(), self.position()
        self.zero += count - here
        self._remember(TrapezoidMove(now, count, count, ()))

    def start(self, target: int, speed: float, acceleration: float) -> None:
        """Move from rest to `target` (counts; counts/s, counts/s²), or to the limit or stall on the way."""
        now, here = self._clock.now(), self.position()
        move = TrapezoidMove.between(here, target, speed, acceleration, begin=now)
        self.ended = Ended(0)
        low, high = self.limits or (-math.inf, math.inf)
        faults = ((self.switch_at, Ended.LIMIT), (self.stall_at, Ended.EMERGENCY))
        for stop, why in ((high, Ended.LIMIT), (low, Ended.LIMIT), *faults):
            if stop is not None and min(here, move.target) < stop < max(here, move.target):
                move, self.ended = move.halted(stop), why
        if (here >= high and move.direction > 0) or (here <= low and move.direction < 0):
            move, self.ended = TrapezoidMove(now, here, here, ()), Ended.LIMIT
        self._remember(move)
        self._put_on_line(now)

    def stop(self, acceleration: float) -> None:
        """Decelerate with `acceleration` (counts/s²) and stop at a whole pulse."""
        now, move = self._clock.now(), self.move
        self.ended = Ended.SLOW_STOP
        if not self.moving():
            return
        self._replace(move.slowed(now, acceleration))
        self._put_on_line(now)

    def halt(self) -> None:
        """Stop at once, at the last pulse sent."""
        now = self._clock.now()
        if self.moving():
            self._replace(self.move.halted(self.position()))
            self._put_on_line(now)
        self.ended = Ended.EMERGENCY

    def _put_on_line(self, now: float) -> None:
        edges = self.trigger.follow(self.move, now)
        if (line := self._line()) is not None:
            line.cancel_after(now)
            line.schedule(Pulse(time, (count - self.zero) * self._angle_of_count) for time, count in edges)
