"""Settings of a Zaber stage, their values in the controller, and a pulse train as its triggers.

One trigger fires once, at the right place, and enables a second that counts distance. The starter fires one step before
the first pulse, the repeater then each step. So the stage may stand anywhere before the train. The time that firmware
needs to act (0.1 to 1 ms, undocumented) delays all pulses alike. If the stage already stands within that step, the
starter gives the first pulse itself. If an action cannot enable a trigger (`chained` false), the repeater alone gives
the train; then the stage must stand one step before the first pulse.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from drivers.base.protocols import StageLimits, TriggerTrain
from drivers.stages.settings import StageFigures, Wiring
from recon.base.setting import CheckedSettings, setting

SHORTEST = 1e-3  # Least s between two fires of a trigger [from memory: firmware checks about this often]


@dataclass(frozen=True, kw_only=True)
class TriggerUse(CheckedSettings):
    """Use of the device's triggers. Defaults are its firmware's behaviour from memory; so is the encoder's unit,
    microsteps.

    Raises:
        ValueError: triggers that cannot work together.
    """

    measured: bool = setting(False, "Pulses by the encoder, not by the commanded position.")
    chained: bool = setting(
        True, "An action may enable another trigger; false: arming turns the stage to one step before the first pulse."
    )
    fires_when_enabled: bool = setting(False, "A distance trigger fires where it is enabled, too.")
    starter: int = setting(1, gt=0)
    repeater: int = setting(2, "The numbers of the two triggers used.", gt=0)
    shortest: float = setting(SHORTEST, "Between two fires at full speed.", unit="s", gt=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.fires_when_enabled and not self.chained:
            raise ValueError("a trigger that fires when enabled needs another one to enable it: chained")
        if self.starter == self.repeater:
            raise ValueError(f"starter and repeater must be two different triggers, got {self.starter} for both")


@dataclass(frozen=True)
class PulseSettings:
    """How pulses are made.

    Attributes:
        output: digital output, from 1.
        width: s, whole ms: the output is set and a schedule resets it. None: fires toggle it, every second one is a
            pulse; then intervals must be even.
        active_high: the output rests low.
    """

    output: int = 1
    width: float | None = 1e-3
    active_high: bool = True
    triggers: TriggerUse = field(default=TriggerUse())

    def __post_init__(self) -> None:
        if self.width is not None and not (self.width > 0 and abs(self.width * 1000 - self.milliseconds) < 1e-6):
            raise ValueError(f"a pulse width of {self.width:g} s is not possible; it is whole milliseconds, 1 or more")

    @property
    def milliseconds(self) -> int:
        return 0 if self.width is None else max(1, round(self.width * 1000))

    @property
    def spacing(self) -> float:
        """Least s between pulses at full speed; the output then rests as long as it is set."""
        return 2 * self.triggers.shortest if self.width is None else max(self.triggers.shortest, 2 * self.width)

    @property
    def rest(self) -> str:
        """The command that puts the output at rest."""
        return f"io set do {self.output} {int(not self.active_high)}"

    @property
    def disable(self) -> tuple[str, str]:
        """Commands that disable both triggers: the starter first, because it enables the repeater."""
        return f"trigger {self.triggers.starter} disable", f"trigger {self.triggers.repeater} disable"

    @property
    def pulse(self) -> str:
        """The action of one fire."""
        if self.width is None:
            return f"io set do {self.output} t"
        on, off = int(self.active_high), int(not self.active_high)
        return f"io set do {self.output} {on} schedule {self.milliseconds} {off}"


@dataclass(frozen=True)
class TriggerSetup:
    """The commands for a train.

    Attributes:
        commands: set both triggers up, with the output at rest; nothing is enabled.
        enable: the last command; from then on the train is armed.
        stand: count at which the stage must stand for it; None: any count before the first pulse.
    """

    commands: tuple[str, ...]
    enable: str
    stand: int | None


def step_of(settings: PulseSettings, train: TriggerTrain) -> int:
    """Microsteps between two fires. A single pulse may have any interval, so its step does not matter, but is not 0."""
    interval = max(abs(train.interval), 2) if train.n == 1 else abs(train.interval)
    return interval if settings.width is not None else interval // 2


def set_up(settings: PulseSettings, train: TriggerTrain, axis: int, counts: int) -> TriggerSetup:
    """The triggers for a train that can be emitted, with the stage standing at `counts`, before the first pulse."""
    sign, step = (1 if train.interval > 0 else -1), step_of(settings, train)
    starter, repeater = f"trigger {settings.triggers.starter}", f"trigger {settings.triggers.repeater}"
    distance, position = ("encoder dist", "encoder.pos") if settings.triggers.measured else ("dist", "pos")
    before = train.start - sign * step
    fires = 2 * train.n if settings.width is None else train.n
    by_starter = False
    if settings.triggers.fires_when_enabled:
        begin = train.start
    elif sign * (before - counts) > 0:
        begin = before
    else:
        begin, by_starter, fires = train.start, True, fires - 1
    commands = [
        *settings.disable,
        settings.rest,
        f"{repeater} when {axis} {distance} {step}",
        f"{repeater} action a {settings.pulse}",
        f"{repeater} action b none",
    ]
    if not settings.triggers.chained:
        fires += by_starter
        return TriggerSetup(tuple(commands), f"{repeater} enable {fires}", before)
    commands += [
        f"{starter} when {axis} {position} {'>=' if sign > 0 else '<='} {begin}",
        f"{starter} action a {settings.pulse if by_starter else 'none'}",
        f"{starter} action b {f'{repeater} enable {fires}' if fires else 'none'}",
    ]
    return TriggerSetup(tuple(commands), f"{starter} enable 1", None)


def has_started(settings: PulseSettings, shown: str) -> bool:
    """Whether distance is being counted, by the reply to `trigger show`."""
    return not settings.triggers.chained or _state(shown, settings.triggers.starter) == "d"


def remaining(settings: PulseSettings, train: TriggerTrain, shown: str) -> int:
    """Pulses still to come, by the reply to `trigger show`: for each trigger `d` (disabled), `e` or the fires left.

    Raises:
        ValueError: it does not contain these triggers.
    """
    if not has_started(settings, shown):
        return train.n
    left = _state(shown, settings.triggers.repeater)
    fires = int(left) if left.isdigit() else 0
    return fires // 2 if settings.width is None else fires


def _state(shown: str, number: int) -> str:
    states = shown.split()
    if number > len(states):
        raise ValueError(f"{shown!r} does not tell of trigger {number}")
    return states[number - 1]


SPEED_UNIT = 1.6384  # Native speed of one microstep/s; of acceleration it is a ten-thousandth for one microstep/s²


@dataclass(frozen=True, kw_only=True)
class ZaberSettings(TriggerUse, Wiring, StageFigures):
    """Zaber stage that talks ASCII, firmware 7.06 or later, with triggers on a digital output.

    counts_per_turn must be the device's own limit.cycle.dist. The pulse width is whole milliseconds; None is 1 ms, or
    half an interval with `toggle`.

    Raises:
        ValueError: a speed or an acceleration below one native unit, an address that no device has, or pulses that no
            output can give.
    """

    device: int = setting(1, ge=1, le=99)
    axis: int = setting(1, ge=1, le=9)
    serial: str | None = setting(
        None, "Its serial number (system.serial): another device is refused; null: any is taken."
    )
    output: int = setting(1, "Digital output that the trigger pulses come from.", gt=0)
    toggle: bool = setting(
        False,
        "Each fire toggles the output (firmware without `schedule`): every second one is a pulse, intervals are even.",
    )
    speed_unit: float = setting(SPEED_UNIT, "Native speed per microstep/s; the vendor's convention, from memory.", gt=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.limits()

    @property
    def pulse_output(self) -> int:
        return self.output

    @property
    def pulses(self) -> PulseSettings:
        """Settings of the pulses: 1 ms wide unless a width is chosen, or half an interval if fires toggle."""
        width = self.pulse_width
        if self.toggle and width is not None:
            raise ValueError("a toggled output has no pulse width; choose a width or toggle, not both")
        chosen = None if self.toggle else PulseSettings.width if width is None else width
        return PulseSettings(self.output, chosen, self.active_high, self)

    @property
    def native_limits(self) -> tuple[int, int]:
        """Native speed nearest to the full speed, and the steepest native acceleration up to the configured one.

        Raises:
            ValueError: less than one native unit.
        """
        per_radian = self.counts_per_turn / (2 * math.pi) * self.speed_unit
        speed = round(self.max_speed * per_radian)
        steepest = math.floor(self.acceleration * per_radian / 1e4 * (1 + 1e-9))
        if speed < 1 or steepest < 1:
            raise ValueError(
                f"{math.degrees(self.max_speed):g} deg/s and {math.degrees(self.acceleration):g} deg/s² are "
                f"native values of {speed} and {steepest}; the controller's gentlest are 1, "
                f"{math.degrees(1e4 / per_radian):g} deg/s² for the latter"
            )
        return speed, steepest

    def limits(self) -> StageLimits:
        """See `StageSettings`, with firmware that has triggers. The acceleration is the controller's steepest one up to
        the configured one.
        """
        pulses = self.pulses
        _, steepest = self.native_limits
        acceleration = steepest * 1e4 / self.speed_unit * 2 * math.pi / self.counts_per_turn
        return self.limits_with(acceleration, pulses.spacing, interval_unit=2 if pulses.width is None else 1)
