"""Simulated PI GCS 2.0 (C-863 class), the axis: servo, reference, moves, stops, limits, trigger line.

Inside, positions are encoder counts from the reference switch ("true"). On the wire, positions are degrees from the
zero of the axis. Before a reference move, this zero is the position at which the axis was switched on. Nothing runs in
the background: the effects of a move's end happen at the next call. If a manual says nothing, the axis is strict: it
rejects a move during a move.
"""

from __future__ import annotations

from collections.abc import Callable, Set
from dataclasses import dataclass

from drivers.base.clock import Clock
from drivers.stages.pi_gcs.settings import PiFirstPulse
from simulators.devices.motion import MovedAxis, TrapezoidMove
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.pi_gcs.output import Firmware, PiOutput, WiredOutput

REFERENCE_VELOCITY = 5.0  # degrees/s


class GcsError(Exception):
    """A rejected command, which only sets the error register."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


@dataclass(frozen=True)
class PiAxisBuild:
    """Properties of the simulated axis, and its faults.

    Attributes:
        low, high: travel range and limit switches, degrees.
        found_at: true angle in degrees at which the axis is switched on.
        referenced: True: its zero is already the reference switch; False: its zero is its position at switching on.
        reference_switch, limit_switches: True if the axis has them.
        reference_fails: True: a reference move ends with error 45.
        first_pulse: see `PiFirstPulse`.
        pulse_width: duration in s for which the firmware holds a pulse.
        rising: True: the camera at the trigger output reacts to rising edges; False: to falling ones.
        servo_period: s; positions are compared and read once per period. 0: continuously.
        settle: time in s after a move until the axis reports that it is on target.
        max_velocity, max_acceleration: degrees/s, degrees/s².
        lost: trigger pulses, counted from 0 since power-on, that never reach the line.
        stall_at: a move that would pass this true count ends there with error 1024 and the servo off.
        switch_at: a move that would pass this true count ends there by a limit switch, the servo on.
    """

    counts_per_turn: int = 360_000
    low: float = -720.0
    high: float = 720.0
    found_at: float = 0.0
    referenced: bool = True
    reference_switch: bool = True
    limit_switches: bool = True
    reference_fails: bool = False
    first_pulse: PiFirstPulse = PiFirstPulse.AT_THRESHOLD
    pulse_width: float = 50e-6
    rising: bool = True
    servo_period: float = 0.0
    settle: float = 0.02
    max_velocity: float = 720.0
    max_acceleration: float = 10_000.0
    lost: Set[int] = frozenset()
    stall_at: int | None = None
    switch_at: int | None = None


class GcsAxis(MovedAxis):
    """An axis; only one thread may use it. `line` is the cable in the output with the settings `wired`."""

    def __init__(self, clock: Clock, line: TriggerLine, build: PiAxisBuild, wired: PiOutput) -> None:
        self.build = build
        self.per_degree = build.counts_per_turn / 360.0
        reference = round(build.found_at * self.per_degree)
        super().__init__(clock.now(), reference, build.counts_per_turn)
        self.error = 0
        self.referenced = build.referenced
        self.velocity = min(10.0, build.max_velocity)
        self.acceleration = self.deceleration = min(100.0, build.max_acceleration)
        self._servo = False
        self._clock = clock
        firmware = Firmware(build.first_pulse, build.pulse_width, build.servo_period, build.lost, build.rising)
        self._wired = WiredOutput(wired, line, firmware, self.per_degree)
        self._zero = 0 if build.referenced else reference
        self._target = 0.0
        self._at_end: Callable[[], None] | None = None
        self._referencing = False
        self._hit = 0

    # queries

    def moving(self) -> bool:
        self.catch_up()
        return self._clock.now() < self.move.end

    def referencing(self) -> bool:
        return self.moving() and self._referencing

    def servo(self) -> bool:
        self.catch_up()
        return self._servo

    def on_target(self) -> bool:
        return self.servo() and not self.moving() and self._clock.now() >= self.move.end + self.build.settle

    def position(self) -> float:
        """Degrees from the axis' zero, in whole counts, as of the last servo cycle."""
        self.catch_up()
        return (self._counts(self._clock.now() - self.build.servo_period) - self._zero) / self.per_degree

    def target(self) -> float:
        self.catch_up()
        return self._target

    def switches(self) -> tuple[bool, bool, bool]:
        """True or False for each switch that is on or off: negative limit, reference, positive limit."""
        self.catch_up()
        here = self._counts(self._clock.now()) / self.per_degree
        return here <= self.build.low or self._hit < 0, here >= 0, here >= self.build.high or self._hit > 0

    # actions

    def switch_servo(self, on: bool) -> None:
        if not on and self.moving():
            self._stand_at(self._counts(self._clock.now()))
        self._servo = on

    def move_to(self, degrees: float) -> None:
        if self.moving():
            raise GcsError(93)
        if not self._servo or not self.referenced:
            raise GcsError(5)
        if not self.build.low <= degrees <= self.build.high:
            raise GcsError(7)
        self._target = degrees
        counts = round(degrees * self.per_degree) + self._zero
        self._begin(counts, self.velocity)
        for place, act in ((self.build.stall_at, self._stalled), (self.build.switch_at, self._ran_into_switch)):
            way = self.move.direction * ((place or 0) - self.move.start)
            if place is not None and 0 < way < abs(self.move.target - self.move.start):
                self._end(self.move.halted(place))
                self._at_end = act

    def reference(self, kind: str) -> None:
        """Start the reference move of a command FRF, FNL or FPL."""
        if not self.build.reference_switch and kind == "FRF":
            raise GcsError(31)
        if not self.build.limit_switches and kind != "FRF":
            raise GcsError(32)
        if self.moving():
            raise GcsError(93)
        if not self._servo:
            raise GcsError(5)
        position = {"FRF": 0.0, "FNL": self.build.low, "FPL": self.build.high}[kind]
        self.referenced, self._referencing = False, True
        self._begin(round(position * self.per_degree), REFERENCE_VELOCITY)
        self._at_end = self._reference_reached

    def brake(self) -> None:
        """HLT: decelerate and stop at a whole count."""
        if self.moving():
            self._cut(self.move.slowed(self._clock.now(), self.deceleration * self.per_degree))
        self.error = 10

    def halt(self) -> None:
        """STP, #24: stop at once."""
        if self.moving():
            self._stand_at(self._counts(self._clock.now()))
        self.error = 10

    def switch_trigger(self, output: PiOutput, on: bool) -> None:
        """TRO: switch the trigger output on or off."""
        self.catch_up()
        if output is self._wired.settings:
            self._wired.switch(on, self.move, self._zero, self._clock.now())
        output.on = on

    def catch_up(self) -> None:
        """Apply the effects of the last move's end."""
        if self._at_end is not None and self._clock.now() >= self.move.end:
            act, self._at_end = self._at_end, None
            act()

    def _counts(self, time: float) -> int:
        """True encoder counts: the last edge that the axis has passed."""
        return self._at(time)[0].counts(time)

    def _begin(self, counts: int, velocity: float) -> None:
        now, scale = self._clock.now(), self.per_degree
        rates = (velocity * scale, self.acceleration * scale, now, self.deceleration * scale)
        move = TrapezoidMove.between(self._counts(now), counts, *rates)
        self._hit = 0
        self._remember(move)
        self._wired.begin(move, self._zero, move.begin)

    def _end(self, move: TrapezoidMove) -> None:
        self._replace(move)
        self._wired.cut(move, self._clock.now())

    def _stand_at(self, counts: int) -> None:
        self._cut(self.move.halted(counts))

    def _cut(self, move: TrapezoidMove) -> None:
        """Change the end of the move."""
        self._referencing, self._at_end = False, None
        self._end(move)
        self._target = (move.target - self._zero) / self.per_degree

    def _stalled(self) -> None:
        self._servo, self.error = False, 1024

    def _ran_into_switch(self) -> None:
        self._hit = self.move.direction
        self._target = (self.move.target - self._zero) / self.per_degree

    def _reference_reached(self) -> None:
        self._referencing = False
        if self.build.reference_fails:
            self.error = 45
        else:
            self._zero, self.referenced = 0, True
        self._target = (self.move.target - self._zero) / self.per_degree
