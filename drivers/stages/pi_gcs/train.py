"""Trigger trains by PI GCS 2.0's mode 0 (PositionDistance): step and window of a train, and when a train ends.

The controller gives a pulse at each step between the thresholds, if the stage entered through the start threshold. The
stop threshold lies half an interval behind the last pulse, so that it does not matter whether the threshold itself
fires. No manual says where the first pulse comes. We take it to come at the start threshold, from memory, see
`PiFirstPulse`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from fractions import Fraction

from drivers.base.protocols import TriggerTrain

PULLED_APART = Fraction(1, 10)
"""Largest error of the last pulse, in intervals, by a step that a controller rounds in its reply. Whether it also uses
the rounded step cannot be seen; a smaller error spoils no image.
"""


class PiFirstPulse(StrEnum):
    """Place of a train's first pulse, which the firmware decides. To find out: arm 3 pulses, pass them, and count."""

    AT_THRESHOLD = "at_threshold"
    """At the start threshold: it is put on the first pulse."""
    STEP_AFTER = "step_after"
    """One step behind the start threshold: it is put one interval before the first pulse."""
    GRID = "grid"
    """At whole steps from position 0 inside the window: it begins half an interval before the first pulse, and trains
    must lie on whole intervals.
    """


@dataclass(frozen=True)
class TriggerWindow:
    """In counts: the distance of pulses, begin and end of the window, and the allowed error of a step, which adds up
    over the train. The stage must stand before the window.
    """

    step: Fraction
    start: Fraction
    stop: Fraction
    step_tolerance: Fraction


def window_of(train: TriggerTrain, first_pulse: PiFirstPulse) -> TriggerWindow:
    """The window for a train of at least one pulse and an interval that is not 0.

    Raises:
        ValueError: this firmware cannot put pulses there.
    """
    sign = 1 if train.interval > 0 else -1
    # Thresholds that a controller rounds to the same count would switch the window of a single pulse off.
    alone = train.n == 1 and first_pulse is not PiFirstPulse.GRID
    step = max(abs(train.interval), 2) if alone else abs(train.interval)
    if first_pulse is PiFirstPulse.GRID and train.start % step:
        raise ValueError(
            f"this controller gives pulses only at whole multiples of {step} counts, and {train.start} is none"
        )
    before = {PiFirstPulse.AT_THRESHOLD: Fraction(0), PiFirstPulse.STEP_AFTER: Fraction(step)}
    lead = before.get(first_pulse, Fraction(step, 2))
    tolerance = min(Fraction(1, 2), PULLED_APART * step / max(train.n - 1, 1))
    return TriggerWindow(Fraction(step), train.start - sign * lead, train.end + Fraction(sign * step, 2), tolerance)


def is_spent_by(train: TriggerTrain, here: int, target: int) -> bool:
    """Whether the train must be disarmed for a move from `here` to `target` (counts).

    Either it was emitted, and passing it would emit it again. Or it has begun, and the way back would give pulses.
    """
    sign = 1 if train.interval > 0 else -1
    started, passed = sign * (here - train.start) >= 0, sign * (here - train.end) >= 0
    return passed or (started and sign * (target - here) < 0)
