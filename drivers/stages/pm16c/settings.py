"""Settings of a PM16C stage, their values in the controller, and the pulse width that fits a train."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar

from drivers.base.protocols import StageLimits, TriggerTrain
from drivers.stages.settings import StageFigures, Wiring
from drivers.stages.travel import counts_in
from recon.base.setting import setting

MODES = {1e-3: 5, 100e-6: 4, 10e-6: 3, 200e-9: 2}  # pulse width in s, the widest first, and its TMGM mode


@dataclass(frozen=True)
class PulseWidths:
    """The pulse widths that a train may have, the widest first: the `chosen` one, or all.

    Raises:
        ValueError: the output has no such width.
    """

    chosen: float | None = None

    def __post_init__(self) -> None:
        if self.chosen is not None and not self.allowed:
            raise ValueError(
                f"the trigger output has no pulses of {self.chosen:g} s; legal: {', '.join(f'{w:g}' for w in MODES)} s"
            )

    @property
    def allowed(self) -> list[float]:
        return [width for width in MODES if self.chosen is None or math.isclose(width, self.chosen)]

    @property
    def spacing(self) -> float:
        """Smallest time between pulses in s.

        Closer pulses would merge, and the controller would leave the output high.
        """
        return 2 * self.allowed[-1]

    def widest_for(self, train: TriggerTrain, limits: StageLimits) -> float:
        """The widest pulse for which, at full speed, the output is low for as long as it is high."""
        fits = (w for w in self.allowed if train.n == 1 or abs(train.interval) >= counts_in(2 * w, limits))
        return next(fits, self.allowed[-1])


class Pm16cFirstPulse(StrEnum):
    """Position of the first pulse of a train, which depends on the firmware.

    To find it, arm 3 pulses, pass them, and count.
    """

    AT_START = "at_start"
    """The first pulse is at the start point."""
    INTERVAL_AFTER = "interval_after"
    """The first pulse is one interval after the start point; the stage must be at rest before the start point."""


@dataclass(frozen=True)
class TriggerPoints:
    """Trigger points in counts, as arguments of TMGS, TMGE and TMGI."""

    start: int
    end: int
    interval: int


def points_of(train: TriggerTrain, first_pulse: Pm16cFirstPulse) -> TriggerPoints:
    """The points for a train of at least one pulse and an interval that is not 0.

    The end point is half an interval after the last pulse, so that it does not matter whether there is a pulse at the
    end point itself. With an interval of one count, the end point is the last pulse.
    """
    sign = 1 if train.interval > 0 else -1
    interval = max(abs(train.interval), 2) if train.n == 1 else abs(train.interval)
    lead = interval if first_pulse is Pm16cFirstPulse.INTERVAL_AFTER else 0
    return TriggerPoints(train.start - sign * lead, train.end + sign * (interval // 2), interval)


MAX_SPEED = 5_000_000  # pulses/s
MAX_COUNT = 2_147_483_647  # largest position, trigger point and limit in both directions
E24 = (10, 11, 12, 13, 15, 16, 18, 20, 22, 24, 27, 30, 33, 36, 39, 43, 47, 51, 56, 62, 68, 75, 82, 91)
_TRIED = (m / 10 * 10.0**e for m in E24 for e in range(-2, 4))
RATES = sorted((ms for ms in _TRIED if 0.0155 < ms < 1005), reverse=True)
"""For each RTE code 0 to 115, ms per 1000 pulses/s: the preferred numbers of IEC 60063 from 1000 down to 0.016."""


def steepest_code(acceleration: float) -> int:
    """The code of the highest acceleration up to `acceleration` (pulses/s²).

    Raises:
        ValueError: even the lowest acceleration of the controller is above `acceleration`.
    """
    codes = [code for code, ms in enumerate(RATES) if 1e6 / ms <= acceleration * (1 + 1e-9)]
    if not codes:
        least_acceleration = 1e6 / RATES[0]
        raise ValueError(
            f"{acceleration:g} pulses/s² is below the controller's least acceleration, {least_acceleration:g}"
        )
    return codes[-1]


@dataclass(frozen=True, kw_only=True)
class PM16CSettings(Wiring, StageFigures):
    """Tsuji PM16C-04XD pulse-motor controller on a serial port, a TCP port or simulated.

    Raises:
        ValueError: the controller does not have this speed, position, pulse width, polarity or channel, or the
            acceleration is below its lowest one.
    """

    pulse_output: ClassVar[None] = None
    """Pulses come from TP0; no output can be set."""
    baudrate: int = setting(9600, gt=0)
    channel: int = setting(0, ge=0, le=15)
    first_pulse: Pm16cFirstPulse = setting(
        Pm16cFirstPulse.AT_START,
        "Where the firmware puts the first pulse of a series: at the start point (an assumption, not from the "
        "manual), or one interval after the start point.",
    )
    home: float | None = setting(
        None, "Angle of the home switch; null: there is no home switch, and no search is made.", unit="deg"
    )
    home_speed: float | None = setting(
        None, "Speed of the search for the home switch; null: a tenth of max_speed_deg_s.", unit="deg_s", gt=0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.active_high:
            raise ValueError("active_high cannot be false: the PM16C's trigger output has one polarity")
        if self.home is not None and not abs(self.home) * self.per_radian <= MAX_COUNT:
            raise ValueError(f"the home switch cannot be at {math.degrees(self.home):g} deg")
        self.limits()
        if not 1 <= self.search_rate <= self.fastest:
            raise ValueError(f"the search for home cannot run at {self.search_rate} pulses/s")

    @property
    def widths(self) -> PulseWidths:
        """Pulse widths that a train may use."""
        return PulseWidths(self.pulse_width)

    @property
    def fastest(self) -> int:
        """Full speed in pulses/s."""
        return round(self.max_speed * self.counts_per_turn / (2 * math.pi))

    @property
    def search_rate(self) -> int:
        """Speed of the search for the home switch in pulses/s."""
        most, speed = 2 * self.max_speed, self.home_speed
        speed = self.max_speed / 10 if speed is None else speed
        return round(speed * self.counts_per_turn / (2 * math.pi)) if 0 < speed < most else 0

    @property
    def rate_code(self) -> int:
        """RTE code of the acceleration."""
        return steepest_code(self.acceleration / (2 * math.pi / self.counts_per_turn))

    def limits(self) -> StageLimits:
        """See `StageSettings`.

        The acceleration is the controller's highest one up to the configured one. If the first pulse is an interval
        after the start point, the stage must be more than an interval before the first pulse. The pause between pulses
        is as long as a pulse.
        """
        radians = 2 * math.pi / self.counts_per_turn
        if max(abs(self.low), abs(self.high)) > MAX_COUNT * radians:
            most = math.degrees(MAX_COUNT * radians)
            raise ValueError(f"the controller counts up to {MAX_COUNT}, which is {most:g} deg")
        if not 1 <= self.fastest <= MAX_SPEED:
            speed = math.degrees(self.max_speed)
            raise ValueError(f"{speed:g} deg/s are {self.fastest} pulses/s, but the controller allows 1 to {MAX_SPEED}")
        acceleration = 1e6 / RATES[self.rate_code] * radians
        run_up = 1 if self.first_pulse is Pm16cFirstPulse.INTERVAL_AFTER else 0
        return self.limits_with(acceleration, self.widths.spacing, run_up=run_up)
