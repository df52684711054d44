"""Simulated Tsuji PM16C-04XD, the wire: converts bytes to lines to commands of the box, and its replies to bytes.

ASCII lines end with CR LF both ways. Queries are answered, settings are not. An unknown command, or a setting
that the box refuses, only sets an error flag (ERRF?, ERR?).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Set
from dataclasses import dataclass, field
from typing import Self, TypeVar

from drivers.base.clock import Clock
from drivers.stages.pm16c.settings import Pm16cFirstPulse, PM16CSettings
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.pm16c.box import WIDTHS, BoxBuild, PM16CBox, Pm16cError, Refused
from simulators.wires.wire import BytesWire

END = b"\r\n"
LONGEST_LINE = 256
ERROR_TEXT = {
    Pm16cError.COMMAND: "COMMAND ERROR",
    Pm16cError.BUSY: "MCC06 BUSY ERROR",
    Pm16cError.BAD_ABS: "BAD ABS COMMAND",
}

_C = "([0-9A-F])"
_D = r"([+-]?\d{1,12})"
T = TypeVar("T")
Query = Callable[..., str]
Setting = Callable[..., None]


def _clear_errors(box: PM16CBox) -> None:
    box.errors = Pm16cError(0)


def _set_limit(box: PM16CBox, side: str, c: str, value: str) -> None:
    box.standing(c).soft[side] = int(value)


def _set_switches(box: PM16CBox, c: str, bits: str) -> None:
    box.standing(c).switches = bits


QUERIES: tuple[tuple[str, Query], ...] = (
    (r"VER\?", lambda box: box.version),
    (r"SETCH\?", lambda box: box.mapped),
    (rf"PS\?{_C}", lambda box, c: f"{box.channels[c].motor.position():+08d}"),
    (rf"SHP\?{_C}", PM16CBox.home),
    (rf"SPD\?{_C}", lambda box, c: f"{box.channels[c].selected}SPD"),
    (rf"SPD([HML])\?{_C}", lambda box, level, c: f"{box.channels[c].speeds[level]:07d}"),
    (rf"RTE\?{_C}", lambda box, c: f"{box.channels[c].rate:03d}"),
    (rf"([FB])L\?{_C}", lambda box, side, c: f"{box.channels[c].soft[side]:+08d}"),
    (rf"SETLS\?{_C}", lambda box, c: box.channels[c].switches),
    (rf"STS{_C}\?", PM16CBox.channel_status),
    (r"STQ\?", lambda box: f"{box.place}{4 - box.moving()}"),
    (r"ERR\?", lambda box: next((text for flag, text in ERROR_TEXT.items() if flag in box.errors), "NO ERROR")),
    (r"ERRF\?", lambda box: f"{box.errors:02X}"),
    (rf"TMGM\?{_C}", PM16CBox.mode),
    (rf"TMGS\?{_C}", lambda box, c: f"{box.channels[c].motor.trigger.settings.start:+08d}"),
    (rf"TMGE\?{_C}", lambda box, c: f"{box.channels[c].motor.trigger.settings.end:+08d}"),
    (rf"TMGI\?{_C}", lambda box, c: f"{box.channels[c].motor.trigger.settings.interval:07d}"),
    (rf"TMGR\?{_C}", lambda box, c: "YES" if box.channels[c].motor.trigger.ready(box.clock.now()) else "NO"),
)

ALWAYS: tuple[tuple[str, Setting], ...] = (
    (r"REM", lambda box: box.set_remote(True)),
    (r"LOC", lambda box: box.set_remote(False)),
    (rf"SSTP{_C}", PM16CBox.slow_stop),
    (rf"ESTP{_C}", lambda box, c: box.channels[c].motor.halt()),
    (r"ASSTP", lambda box: box.for_moving(box.slow_stop)),
    (r"AESTP", lambda box: box.for_moving(lambda c: box.channels[c].motor.halt())),
    (r"ERRC", _clear_errors),
)
"""Settings that are also accepted in LOCAL."""

REMOTE_ONLY: tuple[tuple[str, Setting], ...] = (
    (r"SETCH([0-9A-F-]{4})", PM16CBox.map),
    (rf"ABS{_C}{_D}", lambda box, c, d: box.start(c, int(d))),
    (rf"REL{_C}{_D}", lambda box, c, d: box.start(c, box.channels[c].motor.position() + int(d))),
    (rf"PS{_C}{_D}", lambda box, c, d: box.preset(c, int(d))),
    (rf"FDHP{_C}", PM16CBox.find_home),
    (rf"GTHP{_C}", PM16CBox.go_home),
    (rf"SPD([HML]){_C}(\d*)", PM16CBox.set_speed),
    (rf"RTE{_C}(\d{{1,3}})", lambda box, c, d: box.set_rate(c, int(d))),
    (rf"([FB])L{_C}{_D}", _set_limit),
    (rf"SETLS{_C}([01]{{4}}0[01]{{3}})", _set_switches),
    (rf"TMGM{_C}([02-5])", lambda box, c, digit: box.set_trigger(c, width=WIDTHS[digit])),
    (rf"TMGS{_C}{_D}", lambda box, c, d: box.set_trigger(c, start=int(d))),
    (rf"TMGE{_C}{_D}", lambda box, c, d: box.set_trigger(c, end=int(d))),
    (rf"TMGI{_C}(\d{{1,10}})", lambda box, c, d: box.set_trigger(c, interval=int(d))),
    (rf"TMGR{_C}", PM16CBox.arm),
    (rf"TMGC{_C}", lambda box, c: box.standing(c).motor.trigger.clear()),
)


@dataclass(frozen=True)
class PM16CBuild:
    """Properties of the simulated controller, and its faults.

    Attributes:
        box: the controller behind the wire.
        silent, garbled: queries (counted from 0 since power-on) that get no reply, or a damaged reply.
    """

    box: BoxBuild = field(default=BoxBuild())
    silent: Set[int] = frozenset()
    garbled: Set[int] = frozenset()

    @classmethod
    def matching(cls, settings: PM16CSettings) -> Self:
        at_start = settings.first_pulse is Pm16cFirstPulse.AT_START
        return cls(BoxBuild(settings.channel, settings.counts_per_turn, fires_at_start=at_start))

    def controller(self, clock: Clock, line: TriggerLine) -> PM16CController:
        return PM16CController(clock, line, self)


class PM16CController(BytesWire):
    """The simulated controller at the other end of the cable. None of its outputs can be set.

    Args:
        line: the cable in the TP0 connector (position controller A); it also learns the sample's true angle.
    """

    def __init__(self, clock: Clock, line: TriggerLine, build: PM16CBuild) -> None:
        super().__init__(clock)
        self.queries = 0
        self.box = PM16CBox(clock, line, build.box)
        self._silent, self._garbled = build.silent, build.garbled
        self._turns(line, self.box.sample.angle_at)

    def _take(self, data: bytes) -> None:
        self._take_lines(data, END, self._do)
        if len(self._in) > LONGEST_LINE:
            self._in.clear()
            self.box.errors |= Pm16cError.COMMAND

    def _do(self, line: bytes) -> None:
        text = line.decode("ascii", errors="replace")
        if (answer := _find(QUERIES, text)) is not None:
            self._reply(answer(self.box))
        elif (act := _find(ALWAYS, text) or (_find(REMOTE_ONLY, text) if self.box.remote else None)) is not None:
            try:
                act(self.box)
            except Refused as refusal:
                self.box.errors |= refusal.flag
        else:
            self.box.errors |= Pm16cError.COMMAND

    def _reply(self, text: str) -> None:
        query, self.queries = self.queries, self.queries + 1
        if query in self._garbled:
            self._send(b"\xfe\x00" + text[::-1].encode("ascii") + END)
        elif query not in self._silent:
            self._send(text.encode("ascii") + END)


def _find(table: tuple[tuple[str, Callable[..., T]], ...], text: str) -> Callable[[PM16CBox], T] | None:
    """The action for a line, with the fields of the line as its arguments."""
    for pattern, action in table:
        if match := re.fullmatch(pattern, text):
            return lambda box: action(box, *match.groups())
    return None
