"""A pulse train as Zaber triggers: one fires once, at the right place, and enables another that counts distance there.

The starter fires one step before the first pulse, the repeater then each step: so the stage may stand anywhere before
the train, and the time that firmware needs to act (0.1 to 1 ms, undocumented) delays all pulses alike. Where the stage
stands within that step already, the starter gives the first pulse itself. Where an action cannot enable a trigger
(`chained` false), the repeater alone gives the train; then the stage must stand one step before the first pulse.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from drivers.protocols import TriggerTrain

SHORTEST = 1e-3
"""s between two fires of a trigger that firmware is trusted to keep up with [memory: it looks about this often]."""


@dataclass(frozen=True)
class PulseSettings:
    """How pulses are made.

    Attributes:
        output: digital output, from 1.
        width: s, whole ms: the output is set and a schedule resets it. None: fires toggle it, every second one is a
            pulse; then intervals must be even.
        active_high: the output rests low.
        measured: distance and position by the encoder, not as commanded [its unit from memory: microsteps, too].
        chained: an action may enable another trigger [from memory].
        fires_when_enabled: a distance trigger fires at the very point of enabling, not first one distance on [memory
            has it not].
        starter, repeater: numbers of the two triggers used.
        shortest: s that two fires must be apart at full speed.
    """

    output: int = 1
    width: float | None = 1e-3
    active_high: bool = True
    measured: bool = False
    chained: bool = True
    fires_when_enabled: bool = False
    starter: int = 1
    repeater: int = 2
    shortest: float = SHORTEST

    def __post_init__(self) -> None:
        if self.width is not None and not (self.width > 0 and abs(self.width * 1000 - self.milliseconds) < 1e-6):
            raise ValueError(f"a pulse width of {self.width:g} s is not possible; it is whole milliseconds, 1 or more")
        if self.fires_when_enabled and not self.chained:
            raise ValueError("a trigger that fires when enabled needs another one to enable it: chained")
        if self.starter == self.repeater or min(self.starter, self.repeater, self.output) < 1:
            raise ValueError("starter and repeater are two different triggers, they and outputs count from 1")

    @property
    def milliseconds(self) -> int:
        return 0 if self.width is None else max(1, round(self.width * 1000))

    @property
    def spacing(self) -> float:
        """s that pulses must be apart at full speed; the output then rests as long as it is set."""
        return 2 * self.shortest if self.width is None else max(self.shortest, 2 * self.width)

    @property
    def rest(self) -> str:
        """The command that puts the output at rest."""
        return f"io set do {self.output} {int(not self.active_high)}"

    @property
    def disable(self) -> tuple[str, str]:
        """The starter first, for it enables the repeater."""
        return f"trigger {self.starter} disable", f"trigger {self.repeater} disable"

    @property
    def pulse(self) -> str:
        """The action of one fire."""
        if self.width is None:
            return f"io set do {self.output} t"
        on, off = int(self.active_high), int(not self.active_high)
        return f"io set do {self.output} {on} schedule {self.milliseconds} {off}"


def pulses_of(
    rest: PulseSettings, *, output: int, width: float | None, active_high: bool, toggle: bool
) -> PulseSettings:
    """What was chosen of the output (`width` None: 1 ms, or half an interval where fires toggle it) with the `rest`.

    Raises:
        ValueError: no output can be so.
    """
    if toggle and width is not None:
        raise ValueError("a toggled output has no pulse width of its own; choose a width or toggle, not both")
    made = None if toggle else PulseSettings.width if width is None else width
    return replace(rest, output=output, width=made, active_high=active_high)


@dataclass(frozen=True)
class TriggerSetup:
    """What to send for a train.

    Attributes:
        commands: set both triggers up, with the output at rest; nothing is enabled.
        enable: the last command; from then on the train is armed.
        stand: count where the stage must stand when that is sent; None where any before the first pulse does.
    """

    commands: tuple[str, ...]
    enable: str
    stand: int | None


def step_of(settings: PulseSettings, train: TriggerTrain) -> int:
    """Microsteps between two fires. A single pulse may have any interval: its step is then of no matter, but not 0."""
    interval = max(abs(train.interval), 2) if train.n == 1 else abs(train.interval)
    return interval if settings.width is not None else interval // 2


def set_up(settings: PulseSettings, train: TriggerTrain, axis: int, counts: int) -> TriggerSetup:
    """The triggers for a train that can be emitted, with the stage standing at `counts`, before the first pulse."""
    sign, step = (1 if train.interval > 0 else -1), step_of(settings, train)
    starter, repeater = f"trigger {settings.starter}", f"trigger {settings.repeater}"
    distance, position = ("encoder dist", "encoder.pos") if settings.measured else ("dist", "pos")
    before = train.start - sign * step
    fires = 2 * train.n if settings.width is None else train.n
    by_starter = False
    if settings.fires_when_enabled:
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
    if not settings.chained:
        fires += by_starter
        return TriggerSetup(tuple(commands), f"{repeater} enable {fires}", before)
    commands += [
        f"{starter} when {axis} {position} {'>=' if sign > 0 else '<='} {begin}",
        f"{starter} action a {settings.pulse if by_starter else 'none'}",
        f"{starter} action b {f'{repeater} enable {fires}' if fires else 'none'}",
    ]
    return TriggerSetup(tuple(commands), f"{starter} enable 1", None)


def begun(settings: PulseSettings, shown: str) -> bool:
    """Distance is being counted, as `trigger show` tells."""
    return not settings.chained or _state(shown, settings.starter) == "d"


def remaining(settings: PulseSettings, train: TriggerTrain, shown: str) -> int:
    """Pulses still to come by what `trigger show` tells: for each trigger `d` (disabled), `e` or the fires left.

    Raises:
        ValueError: it does not tell of these triggers.
    """
    if not begun(settings, shown):
        return train.n
    left = _state(shown, settings.repeater)
    fires = int(left) if left.isdigit() else 0
    return fires // 2 if settings.width is None else fires


def _state(shown: str, number: int) -> str:
    states = shown.split()
    if number > len(states):
        raise ValueError(f"{shown!r} does not tell of trigger {number}")
    return states[number - 1]
