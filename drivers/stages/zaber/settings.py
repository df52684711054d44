"""Settings of a Zaber stage, and their values in the controller: whole native speeds and accelerations."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from drivers.base.protocols import StageLimits
from drivers.flat import Declared
from drivers.stages.settings import StageFigures, Wiring, key
from drivers.stages.zaber.train import PulseSettings, TriggerUse

SPEED_UNIT = 1.6384  # Native speed of one microstep/s; of acceleration it is a ten-thousandth for one microstep/s²


@dataclass(frozen=True)
class ZaberSettings(Declared):
    """Zaber stage that talks ASCII, firmware 7.06 or later, with triggers on a digital output.

    counts_per_turn must be the device's own limit.cycle.dist. The pulse width is whole milliseconds; None is 1 ms, or
    half an interval with `toggle`.

    Raises:
        ValueError: a speed or an acceleration below one native unit, an address that no device has, or pulses that no
            output can give.
    """

    figures: StageFigures
    wiring: Wiring = field(default=Wiring())
    device: int = key(1, ge=1, le=99)
    axis: int = key(1, ge=1, le=9)
    serial: str | None = key(None, "Its serial number (system.serial): another device is refused; null: any is taken.")
    output: int = key(1, "Digital output that the trigger pulses come from.", gt=0)
    toggle: bool = key(
        False,
        "Each fire toggles the output (firmware without `schedule`): every second one is a pulse, intervals are even.",
    )
    speed_unit: float = key(SPEED_UNIT, "Native speed per microstep/s; the vendor's convention, from memory.", gt=0)
    triggers: TriggerUse = field(default=TriggerUse())

    def __post_init__(self) -> None:
        super().__post_init__()
        self.limits()

    @property
    def pulse_output(self) -> int:
        return self.output

    @property
    def pulses(self) -> PulseSettings:
        """Settings of the pulses: 1 ms wide unless a width is chosen, or half an interval if fires toggle."""
        width = self.wiring.pulse_width
        if self.toggle and width is not None:
            raise ValueError("a toggled output has no pulse width of its own; choose a width or toggle, not both")
        chosen = None if self.toggle else PulseSettings.width if width is None else width
        return PulseSettings(self.output, chosen, self.wiring.active_high, self.triggers)

    @property
    def native_limits(self) -> tuple[int, int]:
        """Native speed nearest to the full speed, and the steepest native acceleration up to the configured one.

        Raises:
            ValueError: less than one native unit.
        """
        figures = self.figures
        per_radian = figures.counts_per_turn / (2 * math.pi) * self.speed_unit
        speed = round(figures.max_speed * per_radian)
        steepest = math.floor(figures.acceleration * per_radian / 1e4 * (1 + 1e-9))
        if speed < 1 or steepest < 1:
            raise ValueError(
                f"{math.degrees(figures.max_speed):g} deg/s and {math.degrees(figures.acceleration):g} deg/s² are "
                f"native values of {speed} and {steepest}; the controller's gentlest are 1, "
                f"{math.degrees(1e4 / per_radian):g} deg/s² for the latter"
            )
        return speed, steepest

    def limits(self) -> StageLimits:
        """See `StageSettings`, with firmware that has triggers. The acceleration is the controller's steepest one up to
        the configured one.
        """
        pulses, figures = self.pulses, self.figures
        _, steepest = self.native_limits
        acceleration = steepest * 1e4 / self.speed_unit * 2 * math.pi / figures.counts_per_turn
        return figures.limits(acceleration, pulses.spacing, interval_unit=2 if pulses.width is None else 1)
