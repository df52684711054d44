"""What a PM16C makes of the figures configured for a stage: whole pulses/s, and the accelerations that it has."""

from __future__ import annotations

import math

from drivers.protocols import StageLimits
from drivers.stages.pm16c.channel import MAX_COUNT, MAX_SPEED
from drivers.stages.pm16c.rates import RATES, steepest_code
from drivers.stages.pm16c.train import FirstPulse, PulseWidths
from drivers.stages.travel import check_figures


def limits_of(
    counts_per_turn: int,
    max_speed: float,
    acceleration: float,
    low: float,
    high: float,
    first_pulse: FirstPulse = FirstPulse.AT_START,
    pulse_width: float | None = None,
) -> StageLimits:
    """What the controller makes of the figures configured for a stage (rad/s, rad/s², rad): its acceleration is the
    steepest one that it has and that is not above `acceleration`. Where the first pulse comes an interval after the
    start point, the stage must stand more than that before it. Pulses leave their width between them.

    Raises:
        ValueError: a speed, a place or a width that it does not have, or even its gentlest acceleration is above.
    """
    spacing = PulseWidths(pulse_width).spacing
    check_figures(counts_per_turn, max_speed, acceleration, low, high, spacing)
    radians = 2 * math.pi / counts_per_turn
    if max(abs(low), abs(high)) > MAX_COUNT * radians:
        raise ValueError(f"the controller counts to {MAX_COUNT}, which is {math.degrees(MAX_COUNT * radians):g} deg")
    fastest = round(max_speed / radians)
    if not 1 <= fastest <= MAX_SPEED:
        raise ValueError(
            f"{math.degrees(max_speed):g} deg/s are {fastest} pulses/s, the controller gives 1 to {MAX_SPEED}"
        )
    acceleration = 1e6 / RATES[steepest_code(acceleration / radians)] * radians
    run_up = 1 if first_pulse is FirstPulse.INTERVAL_AFTER else 0
    return StageLimits(counts_per_turn, max_speed, acceleration, low, high, True, run_up, spacing)
