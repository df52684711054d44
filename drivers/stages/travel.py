"""Travel of a stage: converts radians to whole counts, and raises errors for moves and trains beyond the limits."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction

from drivers.base.errors import DeviceRefused, DeviceTimeout
from drivers.base.protocols import StageLimits, TriggerTrain

ROUNDING = 1e-6  # counts; tolerance of a spacing, because speeds in degrees are rounded floats


def counts_in(seconds: float, limits: StageLimits) -> int:
    """Smallest whole number of counts that take at least this long at the stage's full speed."""
    return math.ceil(seconds * limits.max_speed * limits.counts_per_turn / (2 * math.pi) - ROUNDING)


def least_interval(limits: StageLimits) -> int:
    """Smallest number of counts between pulses; closer pulses would merge at the stage's full speed."""
    units = -(-counts_in(limits.pulse_spacing, limits) // limits.interval_unit)
    return max(units, 1) * limits.interval_unit


@dataclass(frozen=True)
class Travel:
    """Limits of a named stage in counts, with texts for messages."""

    name: str
    limits: StageLimits

    def to_counts(self, angle: float) -> int:
        return round(angle * self.limits.counts_per_turn / (2 * math.pi))

    def to_angle(self, counts: int) -> float:
        return counts * 2 * math.pi / self.limits.counts_per_turn

    @property
    def low(self) -> int:
        """counts."""
        return self.to_counts(self.limits.low)

    @property
    def high(self) -> int:
        """counts."""
        return self.to_counts(self.limits.high)

    @property
    def span(self) -> str:
        """The soft limits in words."""
        return f"{math.degrees(self.limits.low):g} to {math.degrees(self.limits.high):g} deg"

    def degrees(self, counts: Fraction | float) -> str:
        """A position as text, in degrees."""
        return f"{float(counts) * 360 / self.limits.counts_per_turn:.4f} deg"

    def described(self) -> dict[str, str | int | float]:
        """The limits, for a file's metadata."""
        return {
            "counts_per_turn": self.limits.counts_per_turn,
            "max_speed_rad_s": self.limits.max_speed,
            "acceleration_rad_s2": self.limits.acceleration,
            "low_rad": self.limits.low,
            "high_rad": self.limits.high,
        }

    def target(self, angle: float) -> int:
        """Count of a target angle in rad.

        Raises:
            DeviceRefused: the angle is beyond the soft limits.
        """
        # also false for NaN and for values that are too large
        near = self.limits.low - 1 <= angle <= self.limits.high + 1
        if not near or not self.low <= self.to_counts(angle) <= self.high:
            raise DeviceRefused(
                self.name,
                f"a move to {math.degrees(angle):g} deg is beyond the soft limits",
                expected=self.span,
                state="Nothing has moved",
            )
        return self.to_counts(angle)

    def no_such_speed(self, speed: float, slowest: str) -> DeviceRefused:
        """The error for a speed in rad/s that the stage does not support."""
        return DeviceRefused(
            self.name,
            f"a speed of {math.degrees(speed):g} deg/s is not possible",
            expected=f"{slowest}, at most {math.degrees(self.limits.max_speed):g} deg/s",
            state="Nothing has moved",
        )

    def native(self, speed: float, scale: float, most: int, unit: str) -> int:
        """A speed (rad/s) in whole steps of the controller, with `scale` steps per radian.

        Raises:
            DeviceRefused: the speed is less than one step or more than `most`.
        """
        steps = round(speed * scale) if 0 < speed < 2 * self.limits.max_speed else 0
        if not 1 <= steps <= most:
            raise self.no_such_speed(speed, f"1 to {most} {unit}")
        return steps

    def refuse_train(self, train: TriggerTrain) -> None:
        """Raise DeviceRefused for a train without pulses or intervals, or beyond the soft limits.

        Also if its pulses would merge at full speed, or their interval is not a multiple of `interval_unit`. The
        interval of a single pulse does not matter.
        """
        interval, least = abs(train.interval), least_interval(self.limits)
        close = train.n > 1 and interval < least
        uneven = train.n > 1 and interval % self.limits.interval_unit != 0
        within = all(self.low <= position <= self.high for position in (train.start, train.end))
        if train.n < 1 or interval == 0 or close or uneven or not within:
            raise self.cannot_emit(train, advice="If pulses must be closer together, lower max_speed" if close else "")

    def cannot_emit(self, train: TriggerTrain, why: str = "", advice: str = "") -> DeviceRefused:
        """The error for a train that the stage cannot emit; the message states the conditions for trains."""
        unit, least = self.limits.interval_unit, least_interval(self.limits)
        multiple = (
            f" apart by a multiple of {unit} counts (a toggled output needs an even number of counts),"
            if unit > 1
            else ""
        )
        return DeviceRefused(
            self.name,
            f"{train.n} pulses every {train.interval} counts from {self.degrees(train.start)} cannot be emitted{why}",
            expected=f"one or more pulses, at least {self.limits.pulse_spacing:g} s apart at full speed, which is "
            f"{least} counts,{multiple} all within {self.span}",
            advice=advice,
            state="Nothing was sent to the stage. The stage is where the last move ended, and will send no trigger "
            "pulses",
        )

    def refuse_late_arming(self, train: TriggerTrain, counts: int, opening: Fraction | int | None = None) -> None:
        """Raise DeviceRefused if the first pulse of a train is not ahead of the stage, which is at `counts`.

        Also if the stage is past `opening`, the count before the first pulse at which the output opens.
        """
        here = self.degrees(counts)
        if train.interval * (train.start - counts) <= 0:
            problem = f"the stage is at {here}, at or past the first pulse at {self.degrees(train.start)}"
            advice = "Move to a position before the first pulse, then prepare the trigger pulses again"
        elif opening is not None and train.interval * (opening - counts) <= 0:
            problem = f"the stage is at {here}, at or past {self.degrees(opening)}, where the pulse output opens"
            distance = self.degrees(abs(train.interval))
            advice = f"Move back by at least {distance}, then prepare the trigger pulses again"
        else:
            return
        raise DeviceRefused(
            self.name, problem, advice=advice, state="Nothing has moved, and the stage will send no trigger pulses"
        )

    def refuse_narrower(self, low: int, high: int, advice: str) -> None:
        """Raise DeviceRefused if the controller's own limits (counts) are narrower than those configured."""
        if self.low < low or self.high > high:
            raise DeviceRefused(
                self.name,
                f"the controller itself is limited to {self.degrees(low)} to {self.degrees(high)}",
                expected=f"room for the configured {self.span}",
                advice=f"Narrow low_deg and high_deg in the configuration, or {advice}",
                state="Nothing has moved",
            )

    def still_moving(self, timeout: float, counts: int, aim: str, request: str, reply: str = "") -> DeviceTimeout:
        """The error for a wait that ended after its timeout (s) before the stage had arrived."""
        return DeviceTimeout(
            self.name,
            f"the stage is still moving after {timeout:g} s",
            request=request,
            reply=reply,
            expected=f"to be at {aim}" if aim else "",
            advice="Allow more time, or stop it",
            state=f"The stage was left moving, and is at {self.degrees(counts)}",
        )

    def not_stopped(self, timeout: float, counts: int, request: str) -> DeviceTimeout:
        """The error for a stop if the stage has not stopped within `timeout` s."""
        return DeviceTimeout(
            self.name,
            f"the stage is still moving {timeout:.1f} s after the stop command",
            request=request,
            advice="Abort, or use the emergency stop",
            state=f"It is moving, at {self.degrees(counts)}",
        )
