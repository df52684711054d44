"""Simulated Tsuji PM16C-04XD, the controller box: sixteen motors, four position controllers, error flags.

Behaviour as in the vendor's remote manual, revision 17 (2017), cross-checked with KEK's drivers. If the manual says
nothing, this box is strict: a setting sent in LOCAL, to a moving motor, or (TMG*) while armed only sets the
command-error flag.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Set
from dataclasses import dataclass, replace
from enum import IntFlag

from drivers.base.clock import Clock
from simulators.devices.motor import PulseMotor
from simulators.devices.trigger_line import TriggerLine

VERSION = "1.50 17-04-01 PM16C-04XDL-SIMULATED"
MAX_COUNT = 2_147_483_647
MAX_SPEED = 5_000_000
MAX_PULSES = 200_000
"""Largest number of pulses of a train: a limit of this simulation, because it computes all pulses when a move
begins."""
WIDTHS = {"0": None, "2": 200e-9, "3": 10e-6, "4": 100e-6, "5": 1e-3}
"""TMGM digit -> the output's pulse width in s; None: off. The gate of digit 1 is not simulated."""

_E24 = (10, 11, 12, 13, 15, 16, 18, 20, 22, 24, 27, 30, 33, 36, 39, 43, 47, 51, 56, 62, 68, 75, 82, 91)


def ms_per_1000_pps(code: int) -> float:
    """ms per 1000 pps of an acceleration code 0..115: the E24 preferred numbers (IEC 60063) from 1000 to 0.016."""
    decade, step = divmod(code + 23, 24)
    return float(f"{_E24[23 - step]}e{2 - decade}")


class Pm16cError(IntFlag):
    """ERRF? flags; the lowest one set names the text of ERR?."""

    COMMAND = 1
    BUSY = 2
    BAD_ABS = 4


class Refused(Exception):  # noqa: N818 - not an error of this program
    """A rejected command, which only sets an error flag."""

    def __init__(self, flag: Pm16cError) -> None:
        super().__init__(flag)
        self.flag = flag


class HomeSwitch:
    """The home switch of a channel. `at`: its place in pulses since power-on; None without a switch.

    The course of a search is from memory: the motor starts towards the switch (the switch shows the side), passes it,
    decelerates and stops beyond it. A preset of the counter does not change the stored position.
    """

    def __init__(self, motor: PulseMotor, at: int | None) -> None:
        self._motor, self.at = motor, at
        self._found: int | None = None
        self._searched_for: int | None = None
        self._incomplete = -math.inf

    def search(self, speed: float, acceleration: float) -> None:
        """Begin to search (pulses/s, pulses/s²) and forget the result of an earlier search."""
        assert self.at is not None, "the box rejects a search without a switch"
        here, home = self._motor.position(), self.at + self._motor.zero
        self._found, self._searched_for = None, home
        beyond = math.ceil(speed**2 / (2 * acceleration)) if home != here else 0
        self._motor.start(home + (beyond if home > here else -beyond), speed, acceleration)
        self._incomplete = self._motor.move.begin

    def found(self) -> int | None:
        """Position in counts at which the search passed the switch; None if it did not pass the switch."""
        move, home = self._motor.move, self._searched_for
        if home is not None and move.begin == self._incomplete:
            low, high = sorted((round(move.start), self._motor.position()))
            if low <= home <= high:
                self._found, self._searched_for = home, None
        return self._found

    def forget_search(self) -> None:
        """Forget the last search, because another move begins."""
        self.found()
        self._searched_for = None


class Channel:
    """A motor and its settings in the box."""

    def __init__(self, motor: PulseMotor, home_at: int | None = None) -> None:
        self.motor = motor
        self.home = HomeSwitch(motor, home_at)
        self.speeds = {"H": 1000, "M": 500, "L": 100}
        self.selected = "H"
        self.rate = 24
        self.soft = {"F": MAX_COUNT, "B": -MAX_COUNT}
        self.switches = "00000000"

    @property
    def acceleration(self) -> float:
        """Acceleration in pps²."""
        return 1e6 / ms_per_1000_pps(self.rate)

    @property
    def letter(self) -> str:
        """P, N or S: the motor turns CW, turns CCW, or is at rest."""
        return "SPN"[self.motor.move.direction] if self.motor.moving() else "S"

    def status(self) -> int:
        """b7 emergency stop, b6 slow stop, b5 limit, b1 driving, b0 busy. It does not show acceleration."""
        return 0b11 if self.motor.moving() else int(self.motor.ended)


@dataclass(frozen=True)
class BoxBuild:
    """Properties of the simulated box, and what is plugged into it.

    Attributes:
        channel: the motor that turns the sample; the others turn nothing.
        counts_per_turn: number of pulses of this motor for 2π.
        home_at: position of its home switch, in pulses since power-on; None: no switch is plugged in.
        version: version of the firmware.
        lost: trigger pulses (from 0, since power-on) that never reach the line.
        stall_at, switch_at: counts at which a move of the sample's motor that would pass stops short, as by an
            interlock or a limit switch.
        fires_at_start: a train's start point itself gives a pulse [from memory: it does].
    """

    channel: int = 0
    counts_per_turn: int = 360_000
    home_at: int | None = 0
    version: str = VERSION
    lost: Set[int] = frozenset()
    stall_at: int | None = None
    switch_at: int | None = None
    fires_at_start: bool = True


class PM16CBox:
    """State and actions; methods take the channel as the hex digit of the protocol. Only one thread may use it.

    Args:
        line: the cable in the TP0 connector, the output of position controller A.
    """

    def __init__(self, clock: Clock, line: TriggerLine, build: BoxBuild) -> None:
        self.clock, self.version = clock, build.version
        self.remote = False
        self.errors = Pm16cError(0)
        self.mapped = "0123"
        sample, turn = f"{build.channel:X}", build.counts_per_turn
        self.channels = {
            name: Channel(PulseMotor(clock, _unplugged, counts_per_turn=turn)) for name in "0123456789ABCDEF"
        }

        self.sample = PulseMotor(
            clock,
            lambda: line if self.mapped[0] == sample else None,  # TP0
            counts_per_turn=turn,
            lost=build.lost,
            stall_at=build.stall_at,
            switch_at=build.switch_at,
            fires_at_start=build.fires_at_start,
        )
        self.channels[sample] = Channel(self.sample, build.home_at)

    def moving(self) -> int:
        """Number of moving motors."""
        return sum(channel.motor.moving() for channel in self.channels.values())

    def standing(self, c: str) -> Channel:
        """The channel if its motor is at rest; raises Refused if the motor moves."""
        if self.channels[c].motor.moving():
            raise Refused(Pm16cError.COMMAND)
        return self.channels[c]

    def set_remote(self, remote: bool) -> None:
        if self.moving():
            raise Refused(Pm16cError.COMMAND)
        self.remote = remote

    def map(self, wanted: str) -> None:
        """Assign channels to position controllers A..D; `-` keeps a controller's channel.

        A channel assigned elsewhere is exchanged.
        """
        if any(self.channels[c].motor.moving() for c in (*wanted.replace("-", ""), *self.mapped)):
            raise Refused(Pm16cError.COMMAND)
        places = list(self.mapped)
        for slot, c in enumerate(wanted):
            if c in places:
                places[places.index(c)] = places[slot]
            if c != "-":
                places[slot] = c
        self.mapped = "".join(places)

    def start(self, c: str, target: int) -> None:
        """Move with the selected speed; at most four motors at once."""
        channel = self._ready_to_move(c, target)
        channel.motor.start(target, channel.speeds[channel.selected], channel.acceleration)

    def find_home(self, c: str) -> None:
        """Search for the home switch with the selected speed."""
        if self.channels[c].home.at is None:
            raise Refused(Pm16cError.COMMAND)
        channel = self._ready_to_move(c, 0)
        channel.home.search(channel.speeds[channel.selected], channel.acceleration)

    def go_home(self, c: str) -> None:
        home = self.channels[c].home.found()
        if home is None:
            raise Refused(Pm16cError.COMMAND)
        self.start(c, home)

    def home(self, c: str) -> str:
        """The reply to SHP?x."""
        home_place = self.channels[c].home.found()
        return "NO H.P" if home_place is None else f"{home_place:+08d}"

    def preset(self, c: str, count: int) -> None:
        """Set the count of the present position to `count`."""
        motor = self.standing(c).motor
        if abs(count) > MAX_COUNT or motor.trigger.ready(self.clock.now()):
            raise Refused(Pm16cError.COMMAND)
        self.channels[c].home.forget_search()
        motor.preset(count)

    def _ready_to_move(self, c: str, target: int) -> Channel:
        channel = self.channels[c]
        if abs(target) > MAX_COUNT:
            raise Refused(Pm16cError.BAD_ABS)
        if channel.motor.moving() or self.moving() >= 4:
            raise Refused(Pm16cError.BUSY)
        channel.home.forget_search()
        channel.motor.limits = (channel.soft["B"], channel.soft["F"]) if channel.switches[0] == "1" else None
        return channel

    def slow_stop(self, c: str) -> None:
        self.channels[c].motor.stop(self.channels[c].acceleration)

    def for_moving(self, stop: Callable[[str], None]) -> None:
        for c, channel in self.channels.items():
            if channel.motor.moving():
                stop(c)

    def set_speed(self, level: str, c: str, value: str) -> None:
        """Set a speed; without a value select it for the next moves."""
        channel = self.standing(c)
        if not value:
            channel.selected = level
        elif 1 <= int(value) <= MAX_SPEED:
            channel.speeds[level] = int(value)
        else:
            raise Refused(Pm16cError.COMMAND)

    def set_rate(self, c: str, code: int) -> None:
        channel = self.standing(c)
        if code > 115:
            raise Refused(Pm16cError.COMMAND)
        channel.rate = code

    def set_trigger(self, c: str, **changes: float | None) -> None:
        """Change the trigger settings of a motor that is at rest and not armed."""
        trigger = self.standing(c).motor.trigger
        settings = replace(trigger.settings, **changes)  # type: ignore[arg-type]
        if trigger.ready(self.clock.now()) or settings.interval < 1:
            raise Refused(Pm16cError.COMMAND)
        trigger.settings = settings

    def arm(self, c: str) -> None:
        motor = self.standing(c).motor
        too_many = len(motor.trigger.settings.points) > MAX_PULSES
        if c not in self.mapped or not motor.trigger.can_arm(motor.position()) or too_many:
            raise Refused(Pm16cError.COMMAND)
        motor.trigger.arm()

    def mode(self, c: str) -> str:
        width = self.channels[c].motor.trigger.settings.width
        return next(digit for digit, own in WIDTHS.items() if own == width)

    @property
    def place(self) -> str:
        return "R" if self.remote else "L"

    def channel_status(self, c: str) -> str:
        """The reply to STSx?; a channel without a position controller shows no switches and no status."""
        channel = self.channels[c]
        bits = f"0{channel.status():02X}" if c in self.mapped else "---"
        return f"{self.place}{c}{channel.letter}{bits}{channel.motor.position():+08d}"


def _unplugged() -> None:
    """The trigger output of a motor without a cable."""
