"""Trapezoidal move (accelerate, constant speed, decelerate) in closed form: position at a time, and time at a
position.

With distance D, speed v and acceleration a the move takes D/v + v/a. If D < v²/a the axis never reaches v, and the move
takes 2√(D/a) (constant-acceleration kinematics). A move that is stopped on the way is another such move with the same
past.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

MOVES_REMEMBERED = 4096  # A camera on a virtual clock may ask for past angles. They are known for this many moves.


@dataclass(frozen=True)
class MotionPhase:
    """A phase with constant acceleration.

    Times are in s after the move began; other values use the unit of the position.
    """

    begin: float
    duration: float
    position: float
    velocity: float
    acceleration: float

    @property
    def end(self) -> float:
        return self.begin + self.duration

    def position_after(self, seconds: float) -> float:
        return self.position + (self.velocity + 0.5 * self.acceleration * seconds) * seconds

    def velocity_after(self, seconds: float) -> float:
        return self.velocity + self.acceleration * seconds


@dataclass(frozen=True)
class TrapezoidMove:
    """A move from `start` to `target` that began at `begin` (s, on any clock). `between` builds it.

    `beyond`: function of time; additional rotation that the controller does not report as a move: by a hand on the
    knob, a hunting servo, or a motor that continues after "done". None: there is no such rotation.
    """

    begin: float
    start: float
    target: float
    phases: tuple[MotionPhase, ...]
    beyond: Callable[[float], float] | None = None

    @classmethod
    def between(
        cls,
        start: float,
        target: float,
        speed: float,
        acceleration: float,
        begin: float,
        deceleration: float | None = None,
    ) -> TrapezoidMove:
        """The fastest move from rest to rest with |velocity| <= speed and |acceleration| <= acceleration.

        While it slows down, `deceleration` is the limit; None: the same as `acceleration`.

        Raises:
            ValueError: speed or acceleration is not positive.
        """
        if not (speed > 0 and acceleration > 0):
            raise ValueError(f"speed and acceleration must be positive, got {speed} and {acceleration}")
        distance, sign = abs(target - start), math.copysign(1.0, target - start)
        slow = deceleration or acceleration
        mean = acceleration if slow == acceleration else 2 * acceleration * slow / (acceleration + slow)
        peak = min(speed, math.sqrt(distance * mean))
        rise, fall = peak / acceleration, peak / slow
        cruise = max(0.0, distance / peak - (rise + fall) / 2) if peak > 0 else 0.0
        up = MotionPhase(0.0, rise, start, 0.0, sign * acceleration)
        flat = MotionPhase(rise, cruise, start + sign * 0.5 * peak * rise, sign * peak, 0.0)
        down = MotionPhase(flat.end, fall, target - sign * 0.5 * peak * fall, sign * peak, -sign * slow)
        return cls(begin, start, target, tuple(phase for phase in (up, flat, down) if phase.duration > 0))

    @property
    def duration(self) -> float:
        """Duration in s."""
        return self.phases[-1].end if self.phases else 0.0

    @property
    def end(self) -> float:
        """Time at which the axis is at rest again."""
        return self.begin + self.duration

    @property
    def direction(self) -> int:
        """+1, -1, or 0 for a move to the present position."""
        return (self.target > self.start) - (self.target < self.start)

    def position(self, time: float) -> float:
        return self._commanded(time) + (0.0 if self.beyond is None else self.beyond(time))

    def _commanded(self, time: float) -> float:
        phase = self._phase(time)
        if phase is None:
            return self.start if time < self.begin else self.target
        low, high = sorted((self.start, self.target))
        return min(max(phase.position_after(time - self.begin - phase.begin), low), high)

    def counts(self, time: float) -> int:
        """The last whole position passed on the way."""
        exact = self.position(time)
        return math.floor(exact) if self.direction >= 0 else math.ceil(exact)

    def velocity(self, time: float) -> float:
        phase = self._phase(time)
        return 0.0 if phase is None else phase.velocity_after(time - self.begin - phase.begin)

    def time_at(self, position: float) -> float:
        """Time at which the move passes `position`.

        Raises:
            ValueError: the move does not pass this position.
        """
        low, high = sorted((self.start, self.target))
        if not low <= position <= high:
            raise ValueError(f"a move from {self.start} to {self.target} does not pass {position}")
        sign = self.direction
        for phase in self.phases:
            ahead = sign * (position - phase.position)
            if ahead <= sign * (phase.position_after(phase.duration) - phase.position):
                return self.begin + phase.begin + min(_seconds_for(max(ahead, 0.0), phase, sign), phase.duration)
        return self.end

    def braked(self, time: float, acceleration: float) -> TrapezoidMove:
        """The same move until `time`, then decelerated to rest with `acceleration` (> 0)."""
        past, velocity, here = self._until(time), self.velocity(time), self.position(time)
        seconds = abs(velocity) / acceleration
        if seconds == 0:
            return TrapezoidMove(self.begin, self.start, here, past)
        slow = MotionPhase(time - self.begin, seconds, here, velocity, -math.copysign(acceleration, velocity))
        return TrapezoidMove(self.begin, self.start, slow.position_after(seconds), (*past, slow))

    def halted(self, position: float) -> TrapezoidMove:
        """The same move until it reaches `position`, and an immediate halt there, as by an emergency stop.

        Raises:
            ValueError: the move does not pass there.
        """
        return TrapezoidMove(self.begin, self.start, position, self._until(self.time_at(position)))

    def slowed(self, time: float, deceleration: float) -> TrapezoidMove:
        """The same move until `time`, then slowed down with `deceleration` (> 0) to a whole position.

        This position is the last whole one before the axis would come to rest."""
        position, velocity = self.position(time), self.velocity(time)
        stand = position + self.direction * velocity**2 / (2 * deceleration)
        last = math.floor(stand) if self.direction > 0 else math.ceil(stand)
        if self.direction * (last - position) <= 0:
            return self.halted(self.counts(time))
        braked = self.braked(time, velocity**2 / (2 * abs(last - position)))
        return TrapezoidMove(braked.begin, braked.start, last, braked.phases)

    def _phase(self, time: float) -> MotionPhase | None:
        """The phase at `time`; None before the move and from the rounded `end` on."""
        if not self.begin <= time < self.end:
            return None
        return next((phase for phase in self.phases if time - self.begin < phase.end), None)

    def _until(self, time: float) -> tuple[MotionPhase, ...]:
        seconds = time - self.begin
        return tuple(
            replace(phase, duration=min(phase.end, seconds) - phase.begin)
            for phase in self.phases
            if phase.begin < seconds
        )


class MovedAxis:
    """An axis that rotates the sample with moves in closed form, and keeps the last moves.

    Args:
        begin: time in s on any clock; from this time on, the axis is at rest at `counts`. counts_per_turn: number of
            counts for 2π of true angle.
    """

    def __init__(self, begin: float, counts: float, counts_per_turn: int) -> None:
        self.zero = 0
        """Count at the true angle 0; a preset of the counter changes it."""
        self._angle_of_count = 2 * math.pi / counts_per_turn
        self._moves = deque([(TrapezoidMove(begin, counts, counts, ()), self.zero)], maxlen=MOVES_REMEMBERED)

    @property
    def move(self) -> TrapezoidMove:
        """The present move, or the last one."""
        return self._moves[-1][0]

    def angle_at(self, time: float) -> float:
        """True angle in radians at any time since the oldest move remembered."""
        move, zero = self._at(time)
        return (move.position(time) - zero) * self._angle_of_count

    def disturb(self, beyond: Callable[[float], float]) -> None:
        """Until the next move, rotate the axis by `beyond` (counts at a time in s), which its status does not show."""
        self._replace(replace(self.move, beyond=beyond))

    def _at(self, time: float) -> tuple[TrapezoidMove, int]:
        """The move at a time, and the count at the true angle 0 at this time."""
        return next((past for past in reversed(self._moves) if past[0].begin <= time), self._moves[0])

    def _remember(self, move: TrapezoidMove) -> None:
        """A new move begins."""
        self._moves.append((move, self.zero))

    def _replace(self, move: TrapezoidMove) -> None:
        """Change the end of the present move."""
        self._moves[-1] = (move, self.zero)


def _seconds_for(distance: float, phase: MotionPhase, sign: int) -> float:
    """Time that a phase takes for `distance`: the root of d = vt + at²/2, in the form in which no digits cancel."""
    velocity, acceleration = sign * phase.velocity, sign * phase.acceleration
    root = math.sqrt(max(velocity * velocity + 2.0 * acceleration * distance, 0.0))
    return 2.0 * distance / (velocity + root) if velocity + root > 0 else 0.0
