"""The PM16C's trigger output: the pulse width that fits a train, and its trigger points."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

from drivers.base.protocols import StageLimits, TriggerTrain
from drivers.stages.travel import counts_in

MODES = {1e-3: 5, 100e-6: 4, 10e-6: 3, 200e-9: 2}  # Pulse width in s, the widest first -> TMGM mode


@dataclass(frozen=True)
class PulseWidths:
    """The widths that a train may take, the widest first: the `chosen` one, or all.

    Raises:
        ValueError: the output has no such width.
    """

    chosen: float | None = None

    def __post_init__(self) -> None:
        if self.chosen is not None and not self.allowed:
            raise ValueError(
                f"the trigger output has no pulses of {self.chosen:g} s; it has {', '.join(f'{w:g}' for w in MODES)} s"
            )

    @property
    def allowed(self) -> list[float]:
        return [width for width in MODES if self.chosen is None or math.isclose(width, self.chosen)]

    @property
    def spacing(self) -> float:
        """Least time between pulses in s. Closer ones would merge, and the controller then leaves the output high."""
        return 2 * self.allowed[-1]

    def widest_for(self, train: TriggerTrain, limits: StageLimits) -> float:
        """The widest pulse that leaves the output low as long as high at full speed, for a train with this spacing."""
        fits = (w for w in self.allowed if train.n == 1 or abs(train.interval) >= counts_in(2 * w, limits))
        return next(fits, self.allowed[-1])


class Pm16cFirstPulse(StrEnum):
    """Place of a train's first pulse, which the firmware decides. To find out: arm 3 pulses, pass them, and count."""

    AT_START = "at_start"
    """The start point itself fires."""
    INTERVAL_AFTER = "interval_after"
    """The first pulse comes one interval behind the start point: the stage must stand before that."""


@dataclass(frozen=True)
class TriggerPoints:
    """Trigger points in counts, as arguments of TMGS, TMGE and TMGI."""

    start: int
    end: int
    interval: int


def points_of(train: TriggerTrain, first_pulse: Pm16cFirstPulse) -> TriggerPoints:
    """The points for a train of at least one pulse and an interval that is not 0.

    The end point lies half an interval behind the last pulse, so that a pulse at the end point itself makes no
    difference. At an interval of one count the end point is the last pulse.
    """
    sign = 1 if train.interval > 0 else -1
    interval = max(abs(train.interval), 2) if train.n == 1 else abs(train.interval)
    lead = interval if first_pulse is Pm16cFirstPulse.INTERVAL_AFTER else 0
    return TriggerPoints(train.start - sign * lead, train.end + sign * (interval // 2), interval)
