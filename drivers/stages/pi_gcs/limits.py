"""What a PI GCS 2.0 controller makes of the figures configured for a stage: it takes them as they are, in degrees."""

from __future__ import annotations

import math

from drivers.protocols import StageLimits
from drivers.stages.pi_gcs.train import FirstPulse
from drivers.stages.travel import check_figures

SLOWEST = 1e-6
"""degrees/s that can still be written."""
FIRMWARE_PULSE = 50e-6
"""s that the firmware holds a pulse, from memory."""


def limits_of(
    counts_per_turn: int,
    max_speed: float,
    acceleration: float,
    low: float,
    high: float,
    first_pulse: FirstPulse = FirstPulse.AT_THRESHOLD,
    firmware_pulse: float = FIRMWARE_PULSE,
) -> StageLimits:
    """What the controller makes of the figures configured for a stage (rad/s, rad/s², rad); it takes them as they are.
    Where the first pulse comes a step after the threshold, the stage must stand more than a step before it. Pulses
    leave as long between them as the firmware holds them.

    Raises:
        ValueError: figures that no stage can have.
    """
    check_figures(counts_per_turn, max_speed, acceleration, low, high, 2 * firmware_pulse)
    if min(math.degrees(max_speed), math.degrees(acceleration)) < SLOWEST:
        raise ValueError(f"speed and acceleration must be {SLOWEST:g} deg/s, deg/s² or more")
    run_up = 1 if first_pulse is FirstPulse.STEP_AFTER else 0
    return StageLimits(counts_per_turn, max_speed, acceleration, low, high, True, run_up, 2 * firmware_pulse)
