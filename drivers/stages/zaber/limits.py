"""What a Zaber makes of the figures configured for a stage: whole native speeds and accelerations."""

from __future__ import annotations

import math

from drivers.protocols import StageLimits
from drivers.stages.travel import check_figures
from drivers.stages.zaber.train import PulseSettings

SPEED_UNIT = 1.6384
"""Native speed of one microstep/s; of acceleration it is a ten-thousandth for one microstep/s²."""


def native_limits(
    counts_per_turn: int, max_speed: float, acceleration: float, speed_unit: float = SPEED_UNIT
) -> tuple[int, int]:
    """Native speed nearest to `max_speed` (rad/s) and steepest native acceleration not above `acceleration` (rad/s²).

    Raises:
        ValueError: less than one native unit.
    """
    per_radian = counts_per_turn / (2 * math.pi) * speed_unit
    speed, steepest = round(max_speed * per_radian), math.floor(acceleration * per_radian / 1e4 * (1 + 1e-9))
    if speed < 1 or steepest < 1:
        raise ValueError(
            f"{math.degrees(max_speed):g} deg/s and {math.degrees(acceleration):g} deg/s² are native values of {speed} "
            f"and {steepest}; the controller's gentlest are 1, {math.degrees(1e4 / per_radian):g} deg/s² for the latter"
        )
    return speed, steepest


def limits_of(
    counts_per_turn: int,
    max_speed: float,
    acceleration: float,
    low: float,
    high: float,
    pulses: PulseSettings,
    speed_unit: float = SPEED_UNIT,
) -> StageLimits:
    """What the controller makes of the figures configured for a stage (rad/s, rad/s², rad), with firmware that has
    triggers: its acceleration is the steepest one that it has and that is not above `acceleration`.

    Raises:
        ValueError: figures that no stage can have, or that are less than one native unit.
    """
    check_figures(counts_per_turn, max_speed, acceleration, low, high, pulses.spacing)
    _, steepest = native_limits(counts_per_turn, max_speed, acceleration, speed_unit)
    acceleration = steepest * 1e4 / speed_unit * 2 * math.pi / counts_per_turn
    unit = 2 if pulses.width is None else 1
    return StageLimits(counts_per_turn, max_speed, acceleration, low, high, True, 0, pulses.spacing, unit)
