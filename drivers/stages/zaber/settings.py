"""Settings of a Zaber stage, their values in the controller, and a pulse train programmed as triggers.

One trigger, the starter, fires once at a position, and enables a second one, the repeater, which counts distance. The
starter fires one step before the first pulse, and the repeater then fires at each step. So the stage may be anywhere
before the train. The time that the firmware needs to act (0.1 to 1 ms, undocumented) delays all pulses by the same
time. If the stage is already within this step, the starter gives the first pulse itself. If an action cannot enable a
trigger (`chained` false), the repeater alone gives the train, and the stage must be one step before the first pulse.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from drivers.base.protocols import StageLimits, TriggerTrain
from drivers.stages.settings import StageFigures, Wiring
from recon.base.setting import setting

SHORTEST = 1e-3  # smallest time in s between two fires of a trigger [from memory: interval of the firmware's checks]
# native speed of one microstep/s; for an acceleration of one microstep/s² it is a ten-thousandth of this
SPEED_UNIT = 1.6384


@dataclass(frozen=True, kw_only=True)
class ZaberSettings(Wiring, StageFigures):
    """Zaber stage with the ASCII protocol, firmware 7.06 or later, and triggers on a digital output.

    counts_per_turn must be the device's own limit.cycle.dist. The pulse width is a whole number of milliseconds; None:
    1 ms. With `toggle`, each fire toggles the output, so that every second fire begins a pulse of half an interval, and
    intervals must be even. The defaults of the triggers are the firmware's behaviour from memory, and so is the unit of
    the encoder (microsteps).

    Raises:
        ValueError: a speed or an acceleration is below one native unit, no device has the address, no output can give
            the pulses, or the triggers cannot work together.
    """

    stand_in: ClassVar[str] = "pi_gcs"  # the controller is simulated only in the tests
    device: int = setting(1, ge=1, le=99)
    axis: int = setting(1, ge=1, le=9)
    serial: str | None = setting(
        None,
        "Serial number of the device (system.serial); the driver stops with an error if another device answers. "
        "null: accept any.",
    )
    output: int = setting(1, "Digital output of the trigger pulses.", gt=0)
    toggle: bool = setting(
        False,
        "true: each time the trigger fires, the output changes its level (for firmware without `schedule`). Every "
        "second firing begins a pulse, so intervals must be even.",
    )
    speed_unit: float = setting(
        SPEED_UNIT,
        "Native units of speed for one microstep/s. The default is the vendor's convention (an assumption, not from "
        "the manual).",
        gt=0,
    )
    measured: bool = setting(False, "true: pulses follow the encoder, not the commanded position.")
    chained: bool = setting(
        True,
        "true: the action of a trigger may enable another trigger. false: arming turns the stage to one step before "
        "the first pulse.",
    )
    fires_when_enabled: bool = setting(
        False, "true: a distance trigger also fires at the position where it is enabled."
    )
    starter: int = setting(
        1, "Number, in the controller, of the trigger that starts the pulses; used only if `chained` is true.", gt=0
    )
    repeater: int = setting(
        2, "Number, in the controller, of the trigger that repeats the pulse after each step.", gt=0
    )
    shortest: float = setting(
        SHORTEST, "Shortest time in s between two firings of a trigger, at full speed.", unit="s", gt=0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.fires_when_enabled and not self.chained:
            raise ValueError(
                "a trigger that fires when it is enabled needs another trigger that enables it: set `chained` of this "
                "stage to true"
            )
        if self.starter == self.repeater:
            raise ValueError(f"starter and repeater must be two different triggers, got {self.starter} for both")
        if self.toggle and self.pulse_width is not None:
            raise ValueError("a toggled output has no pulse width; choose a width or toggle, not both")
        if not self.toggle and abs(self.width * 1000 - self.milliseconds) > 1e-6:
            raise ValueError(
                f"a pulse width of {self.width:g} s is not possible; expected a whole number of milliseconds, 1 or more"
            )
        self.limits()

    @property
    def pulse_output(self) -> int:
        return self.output

    @property
    def width(self) -> float:
        """Width in s of a pulse without `toggle`."""
        return 1e-3 if self.pulse_width is None else self.pulse_width

    @property
    def milliseconds(self) -> int:
        return max(1, round(self.width * 1000))

    @property
    def fires(self) -> int:
        """Number of fires for one pulse."""
        return 2 if self.toggle else 1

    @property
    def quiet(self) -> tuple[str, ...]:
        """Commands that disable both triggers (the starter first, because it enables the repeater) and reset the
        output.
        """
        off = f"io set do {self.output} {int(not self.active_high)}"
        return f"trigger {self.starter} disable", f"trigger {self.repeater} disable", off

    @property
    def pulse(self) -> str:
        """The action of a trigger for one fire."""
        on, off = int(self.active_high), int(not self.active_high)
        return f"io set do {self.output} " + ("t" if self.toggle else f"{on} schedule {self.milliseconds} {off}")

    @property
    def native_limits(self) -> tuple[int, int]:
        """The native speed nearest to the full speed, and the highest native acceleration up to the configured one.

        Raises:
            ValueError: a value is less than one native unit.
        """
        per_radian = self.per_radian * self.speed_unit
        speed = round(self.max_speed * per_radian)
        steepest = math.floor(self.acceleration * per_radian / 1e4 * (1 + 1e-9))
        if speed < 1 or steepest < 1:
            least = math.degrees(1e4 / per_radian)
            raise ValueError(
                f"{math.degrees(self.max_speed):g} deg/s and {math.degrees(self.acceleration):g} deg/s² "
                f"become {speed} and {steepest} in the controller's units, but each must be 1 or more. The smallest "
                f"acceleration is {least:g} deg/s²"
            )
        return speed, steepest

    def limits(self) -> StageLimits:
        """See `StageSettings`; for firmware with triggers.

        The acceleration is the controller's highest one up to the configured one. At full speed, the pause between
        pulses is as long as a pulse.
        """
        acceleration = self.native_limits[1] * 1e4 / self.speed_unit / self.per_radian
        spacing = 2 * self.shortest if self.toggle else max(self.shortest, 2 * self.width)
        return self.limits_with(acceleration, spacing, interval_unit=self.fires)


def set_up(settings: ZaberSettings, train: TriggerTrain, counts: int) -> tuple[tuple[str, ...], int]:
    """The triggers for a train that can be emitted; the stage is at rest at `counts`, before the first pulse.

    Returns the commands, of which the last one arms the train, and the count at which the stage must be when it is
    armed.
    """
    sign, fires = (1 if train.interval > 0 else -1), settings.fires * train.n
    step = max(abs(train.interval) // settings.fires, 1)  # the interval of a single pulse may have any value
    starter, repeater = f"trigger {settings.starter}", f"trigger {settings.repeater}"
    distance, position = ("encoder dist", "encoder.pos") if settings.measured else ("dist", "pos")
    before = train.start - sign * step
    by_starter = not settings.fires_when_enabled and sign * (before - counts) <= 0
    begin = train.start if settings.fires_when_enabled or by_starter else before
    commands = (
        *settings.quiet,
        f"{repeater} when {settings.axis} {distance} {step}",
        f"{repeater} action a {settings.pulse}",
        f"{repeater} action b none",
    )
    if not settings.chained:
        return (*commands, f"{repeater} enable {fires}"), before
    left = fires - by_starter
    return (
        *commands,
        f"{starter} when {settings.axis} {position} {'>=' if sign > 0 else '<='} {begin}",
        f"{starter} action a {settings.pulse if by_starter else 'none'}",
        f"{starter} action b {f'{repeater} enable {left}' if left else 'none'}",
        f"{starter} enable 1",
    ), counts
