"""Simulated Zaber axis: moves in microsteps in closed form, homing, stops, limits and their warning flags.

Native units by the vendor's convention (from memory, not confirmed): speed is microsteps/s times 1.6384, acceleration
microsteps/s² times 1.6384 / 10 000. A real axis re-plans a move under way; this one says STATUSBUSY.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from simulators.devices.motion import MovedAxis, TrapezoidMove

SPEED_UNIT = 1.6384
ACCELERATION_UNIT = 1.6384e-4
PRIORITY = "FF FN FZ FH FV FO FC FM FD FQ FI FA FR FS FB FP FE FT WL WV WT WS WM WP WR WH NC NI ND NR NT NU NJ NB"
"""Warning flags, the gravest first."""


class Rejected(Exception):  # noqa: N818 - not an error of this program
    """A command that the device answers with RJ and this reason."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


@dataclass(frozen=True)
class ZaberAxisBuild:
    """How the axis is built, and its faults.

    Attributes:
        counts_per_turn: microsteps for 2π of true angle.
        low, high: its own travel limits in microsteps.
        homed: it knows its reference since power-on; otherwise the flag WR stands.
        stall_at: a move that would pass this count stops there (FS), as if blocked.
        switch_at: a move that would pass this count runs into a limit there (WL, FE).
    """

    counts_per_turn: int = 384_000
    low: int = -2_000_000_000
    high: int = 2_000_000_000
    homed: bool = True
    stall_at: int | None = None
    switch_at: int | None = None


class SimulatedZaberAxis(MovedAxis):
    """One axis. Times are s on the device's clock, positions whole microsteps.

    `stall_at` and `switch_at` may be changed while it stands, as if a person clears the way.
    """

    def __init__(self, now: float, build: ZaberAxisBuild) -> None:
        super().__init__(now, 0.0, build.counts_per_turn)
        self.settings: dict[str, int] = {
            "maxspeed": round(build.counts_per_turn / 36 * SPEED_UNIT),
            "motion.accelonly": 100,
            "motion.decelonly": 100,
            "limit.min": build.low,
            "limit.max": build.high,
        }
        self.homed, self.enabled = build.homed, True
        self.flags: set[str] = set()
        self.stall_at, self.switch_at = build.stall_at, build.switch_at
        self._at_end: Callable[[], None] | None = None

    def moving(self, now: float) -> bool:
        return now < self.move.end

    def position(self, now: float) -> int:
        return self.move.counts(now)

    def settle(self, now: float) -> bool:
        """Set the flags of a move that has ended; returns whether one has ended since the last call."""
        if self._at_end is None or self.moving(now):
            return False
        ending, self._at_end = self._at_end, None
        ending()
        return True

    def warnings(self) -> list[str]:
        """Standing flags, the gravest first."""
        standing = self.flags | (set() if self.homed else {"WR"}) | (set() if self.enabled else {"FO"})
        return sorted(standing, key=PRIORITY.index)

    def disturb(self, beyond: Callable[[float], float], *flags: str) -> None:
        """Disturb the axis, which only these flags show."""
        super().disturb(beyond)
        self.flags.update(flags)

    def start(self, now: float, target: int) -> None:
        """Move to `target`, or to the place where it is blocked."""
        self._ready(now)
        if not self.settings["limit.min"] <= target <= self.settings["limit.max"]:
            raise Rejected("BADDATA")
        move, ending = self._planned(now, target), self._nothing
        for blocked, flags in ((self.stall_at, {"FS"}), (self.switch_at, {"WL", "FE"})):
            if blocked is not None and min(move.start, move.target) < blocked < max(move.start, move.target):
                move, ending = move.halted(blocked), partial(self.flags.update, flags)
        self._begin(move, ending)

    def home(self, now: float) -> None:
        """Turn to the reference, count 0; from then on the position is known."""
        self._ready(now)
        self._begin(self._planned(now, 0), self._found_home)

    def stop(self, now: float) -> None:
        """Slow down and stand at a whole microstep."""
        if not self.moving(now):
            return
        slowed = self.move.slowed(now, self.settings["motion.decelonly"] / ACCELERATION_UNIT)
        if self.move.direction * (self.move.target - slowed.target) > 0:  # otherwise the move ends earlier by itself
            self._replace(slowed)
        self._interrupt()

    def halt(self, now: float) -> None:
        """Stand at once, at the last whole microstep."""
        if self.moving(now):
            self._replace(self.move.halted(self.position(now)))
            self._interrupt()

    def _ready(self, now: float) -> None:
        if self.moving(now):
            raise Rejected("STATUSBUSY")
        if not self.enabled:
            raise Rejected("DRIVERDISABLED")

    def _planned(self, now: float, target: int) -> TrapezoidMove:
        speed = self.settings["maxspeed"] / SPEED_UNIT
        acceleration = min(self.settings["motion.accelonly"], self.settings["motion.decelonly"]) / ACCELERATION_UNIT
        return TrapezoidMove.between(self.position(now), target, speed, acceleration, begin=now)

    def _begin(self, move: TrapezoidMove, ending: Callable[[], None]) -> None:
        self._remember(move)
        self._at_end = ending

    def _nothing(self) -> None:
        """A move that arrives leaves no flag."""

    def _found_home(self) -> None:
        self.homed = True

    def _interrupt(self) -> None:
        """The flag stands at once, also in the interrupting command's reply: the vendor's library clears it there."""
        self._at_end = self._nothing
        self.flags.add("NI")
