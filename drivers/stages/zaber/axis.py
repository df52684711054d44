"""One axis of a Zaber device in the device's own units (microsteps, native speeds), with its settings, flags and
replies.

Every command except a stop has its own message id and waits for its reply, which accepts or rejects the command.
Commands and replies follow Zaber's ASCII protocol version 2, as the vendor's library zaber-motion uses it. The texts
for flags and reasons are our own, after zaber-motion and ArduinoZaberMaster.
"""

from __future__ import annotations

import contextlib
import itertools
import re
from dataclasses import dataclass
from typing import Self

from drivers.base.clock import Clock
from drivers.base.errors import DeviceRefused
from drivers.serial.line import Probe, line_to
from drivers.stages.shared import FoundSettings, while_it_moves
from drivers.stages.zaber.settings import ZaberSettings


@dataclass(frozen=True)
class Meaning:
    """Meaning of a flag or reason, and advice."""

    text: str
    advice: str


FAULTS = {
    "FF": Meaning("critical system error", "Switch the controller off and on; if the error persists, ask the vendor"),
    "FN": Meaning("peripheral not supported", "Check which stage is plugged into the controller"),
    "FZ": Meaning("peripheral inactive", "Plug the stage in again and activate it"),
    "FH": Meaning("emergency stop of the hardware", "Release the emergency stop, then enable the driver"),
    "FV": Meaning("supply voltage out of range, driver off", "Check the power supply"),
    "FO": Meaning(
        "driver disabled", "Find who disabled the driver, then send `driver enable` with the vendor's software"
    ),
    "FC": Meaning("inrush current too high", "Check the motor's cable and the power supply"),
    "FM": Meaning("motor too hot", "Let the stage cool down; use a lower speed or load"),
    "FD": Meaning(
        "driver disabled", "Find the cause of an earlier fault, then send `driver enable` with the vendor's software"
    ),
    "FQ": Meaning("encoder error, the position may be wrong", "Check the encoder's cable, then search the reference"),
    "FI": Meaning("encoder index error", "Search the reference again; check the encoder's cable"),
    "FA": Meaning("analogue encoder out of step", "Search the reference again; check the encoder's cable"),
    "FR": Meaning("overdrive limit", "Use a lower acceleration or load"),
    "FS": Meaning("stalled and stopped", "Find what blocks the stage; use a lower speed, acceleration or load"),
    "FB": Meaning("stream bounds", "Find which program runs a stream (a queue of moves) on this controller"),
    "FP": Meaning("left its path", "Find which program runs an interpolated move on this controller"),
    "FE": Meaning("limit error", "Find why the stage ran into a limit, then search the reference"),
    "FT": Meaning("twisted too far", "Turn the stage back until the cables are straight"),
}
"""Flags of faults; the motor driver may be off."""
ENDINGS = {
    "WL": Meaning(
        "reached a limit switch at an unexpected position",
        "Check travel limits and cables, then search the reference",
    ),
    "WV": Meaning("supply voltage out of range", "Check the power supply"),
    "WT": Meaning("controller hot", "Let it cool down"),
    "WS": Meaning("stalled and recovered", "Use a lower speed, acceleration or load"),
    "WM": Meaning("displaced while at rest", "Find what pushed the stage, then search the reference"),
    "NC": Meaning("moved by its knob", "Do not touch the knob during a scan"),
    "NI": Meaning("movement interrupted", "Find who stopped it"),
}
"""Flags that can explain why a move ended early, in addition to those of faults."""
INTERRUPTED = "NI"
"""The flag that every stop before the end of a move sets, also our own stop. The position is still right."""
SLIPPED = frozenset({"WL", "WS", "WM", "NC"})
"""Flags after which the position may be wrong.

In addition to faults, they are errors of the move in which they occur.
"""
LOST = frozenset({"FS", "FQ", "FI", "FA", "FE"})
"""Flags of faults after which the position may be wrong."""
UNREFERENCED = frozenset({"WR", "WH"})  # flags of an axis that has no reference
REASONS = {
    "AGAIN": "the device repeatedly asks to repeat the request",
    "AXISONLY": "only an axis can answer this command",
    "BADAXIS": "there is no such axis",
    "BADCOMMAND": "the device does not know this command or setting",
    "BADDATA": "a value is missing or out of its range",
    "BADMESSAGEID": "the device cannot read the message number of the request",
    "DEVICEONLY": "only the device, not an axis, can answer this command",
    "DRIVERDISABLED": "the motor driver is disabled",
    "FULL": "the memory of the device is full",
    "INACTIVE": "the peripheral of the device is inactive",
    "NOACCESS": "the access level forbids this command",
    "NOTSUPPORTED": "the peripheral of the device is not supported",
    "PARKED": "the axis is parked",
    "REMOTE": "the device is under remote control by another program",
    "STATUSBUSY": "the device cannot carry out this command while it moves",
    "SYSTEMERROR": "the device had an internal failure",
}


@dataclass(frozen=True)
class Reply:
    """A reply to one command.

    `flag`: the most serious warning, "" if there is none; `data` is "0" if there are no data.
    """

    accepted: bool
    busy: bool
    flag: str
    data: str
    raw: str

    @classmethod
    def of(cls, match: re.Match[str]) -> Self:
        """The reply that matched `reply_form`."""
        return cls(match[1] is not None, match[2] == "BUSY", match[3].strip("-"), match[4], match[0])


def lrc(body: str) -> str:
    """Longitudinal redundancy check: the negative sum of the bytes after the type character, two hex digits."""
    return f"{-sum(body.encode('ascii')) % 256:02X}"


def encode(device: int, axis: int, identity: int, words: str) -> str:
    """A command packet, without its line end."""
    body = f"{device} {axis} {identity:02d} {words}".rstrip()
    return f"/{body}:{lrc(body)}"


def damage(line: str, *, must_have_checksum: bool) -> str:
    """Fault of a received line by its checksum; "" if it is good.

    Only replies, alerts and information have a checksum; other lines count as good.
    """
    if line[:1] not in ("@", "!", "#"):
        return ""
    body, colon, checksum = line[1:].partition(":")
    if not colon:
        return "it has no checksum" if must_have_checksum and line[0] == "@" else ""
    if not body.isascii() or checksum != lrc(body):
        return (
            f"its checksum is {checksum!r}; expected {lrc(body)!r}"
            if body.isascii()
            else "it contains bytes that are not text"
        )
    return ""


def reply_form(device: int, axis: int, identity: int, data: str) -> str:
    """Regular expression of the reply to a command; `data` is the expression for the data of an accepted command."""
    head = rf"@0?{device} {axis} {identity:02d} (?:(OK)|RJ) (BUSY|IDLE) ([A-Z-]{{2}})"
    return rf"{head} ((?(1)(?:{data})|\w+))(?::[0-9A-F]{{2}})?"


def passed_over_form(identity: int) -> str:
    """Regular expression of lines to skip: alerts, information, echoes, empty lines, and replies to this id."""
    return rf"|[!#/].*|@\d\d \d {identity:02d} .*"


def meaning_of(flags: tuple[str, ...]) -> Meaning | None:
    """The most serious of these flags that is a fault or ends moves; None if there is none."""
    known = FAULTS | ENDINGS
    serious = [flag for flag in flags if flag in known or flag.startswith("F")]
    if not serious:
        return None
    meanings = [
        known.get(flag, Meaning("a fault that this driver does not know", "See the vendor's manual"))
        for flag in serious
    ]
    text = ", ".join(f"{meaning.text} ({flag})" for flag, meaning in zip(serious, meanings, strict=True))
    return Meaning(text, meanings[0].advice)


PROBE_ID, STOP_ID, IDS = 98, 99, 98  # ordinary commands use the ids 0 to 97
REPEATS = 3  # how often a command is repeated if the device answers AGAIN
PAUSE = 0.05  # s before a repetition
TEXT, WHOLE, NUMBER = r"[^:]*", r"-?\d{1,12}", r"-?\d{1,12}(?:\.\d{1,12})?"
"""Largest number of digits of a position; a longer number is impossible for an axis and for a float."""
CHECKSUM = "comm.checksum"
BINARY = (
    ". A device that is set to Zaber's Binary protocol (usually at 9600 baud) does not understand ASCII: "
    "switch it with Zaber Launcher, or with the Binary command 124 (Convert To ASCII)"
)
KEPT = ("maxspeed", "motion.accelonly", "motion.decelonly")
"""Settings of the axis that survive switching off. The driver restores them, and the device's checksums, at the end."""


@dataclass(frozen=True)
class ZaberAxisStatus:
    """Position in microsteps, motion, and all warning flags, the most serious first."""

    counts: int
    moving: bool
    flags: tuple[str, ...]
    raw: str

    @property
    def referenced(self) -> bool:
        return UNREFERENCED.isdisjoint(self.flags)

    @property
    def grave(self) -> frozenset[str]:
        """Flags of faults, and of a stage that slipped or was displaced, independent of the last move."""
        return frozenset(flag for flag in self.flags if flag.startswith("F")) | (SLIPPED & set(self.flags))


class ZaberAxis:
    """Controls one axis of one device, and the device itself.

    Raises (here and in all methods):
        DeviceRefused: the device rejects a command. DeviceError: a wrong or damaged reply.
        DeviceTimeout: no reply.
    """

    def __init__(self, url: str, settings: ZaberSettings, clock: Clock, name: str) -> None:
        self._name, self._device, self._axis, self._clock = name, settings.device, settings.axis, clock
        self._ids = itertools.cycle(range(IDS))
        self._must_have_checksum = self._commanded = False
        self.last_move = ""
        """The command of the last move or search, for error messages."""
        self.found = FoundSettings()
        self.flags_at_opening: tuple[str, ...] = ()
        """Flags found at opening, without the flag of a stop, because the position is still right after a stop."""
        self._line = line_to(
            settings,
            url,
            name,
            clock,
            Probe(encode(self._device, 0, PROBE_ID, ""), reply_form(self._device, 0, PROBE_ID, TEXT)),
            unsolicited=passed_over_form(STOP_ID),
            identified=True,
            check=lambda line: damage(line, must_have_checksum=self._must_have_checksum),
            unanswered=BINARY,
        )

    def open(self) -> dict[str, str]:
        """Switch checksums on, identify the device, and store the settings that will change."""
        self._line.send("")  # an empty line ends an incomplete command in the device
        if (checksums := self.get_if_known(CHECKSUM, 0)) is not None:
            self.ask(f"set {CHECKSUM} 1")
            self._must_have_checksum = True
        number = self.get_if_known("device.id", 0) or self.ask("get deviceid", WHOLE)
        serial, firmware = self.ask("get system.serial", WHOLE), self.ask("get version", NUMBER)
        self.flags_at_opening = tuple(flag for flag in self.standing("opening").flags if flag != INTERRUPTED)
        self.found.values = {setting: self.ask_axis(f"get {setting}", NUMBER) for setting in KEPT}
        if checksums is not None:
            self.found.values[CHECKSUM] = checksums
        return {"model": f"Zaber device {number}", "serial": serial, "firmware": firmware}

    def status(self) -> ZaberAxisStatus:
        reply = self._ask(self._axis, "get pos", WHOLE)
        flags = self.ask_axis("warnings", r"\d+(?: \w\w)*").split()[1:] if reply.flag else ()
        return ZaberAxisStatus(int(reply.data), reply.busy, tuple(flags), reply.raw)

    def standing(self, purpose: str) -> ZaberAxisStatus:
        """The status. Raises DeviceRefused for `purpose` while the axis moves."""
        status = self.status()
        if status.moving:
            raise while_it_moves(self._name, purpose, status.counts, status.raw)
        return status

    def begin(self, words: str) -> None:
        """Begin a move or a search."""
        self._commanded, self.last_move = True, words
        self.ask_axis(words)

    def stop(self, words: str) -> str:
        """Send `stop` or `estop` without waiting, and return the command; its reply is skipped when it arrives."""
        self._line.send(packet := encode(self._device, self._axis, STOP_ID, words))
        return packet

    def ask(self, words: str, form: str = TEXT) -> str:
        """Data of the reply of the device (not of an axis)."""
        return self._ask(0, words, form).data

    def ask_axis(self, words: str, form: str = TEXT) -> str:
        return self._ask(self._axis, words, form).data

    def get_if_known(self, setting: str, axis: int) -> str | None:
        """A setting of an axis, or of the device (0); None if there is no such setting."""
        with contextlib.suppress(DeviceRefused):
            return self._ask(axis, f"get {setting}", NUMBER).data
        return None

    def close(self) -> None:
        """Restore the settings, and free the port even if the connection is lost."""
        try:
            self.found.restore(self._restore)
        finally:
            self._line.close()

    def _restore(self, setting: str, value: str) -> None:
        if setting == CHECKSUM:
            self._must_have_checksum = value == "1"
        self._ask(0 if setting == CHECKSUM else self._axis, f"set {setting} {value}", TEXT)

    def _ask(self, axis: int, words: str, form: str) -> Reply:
        for _ in range(REPEATS):
            reply = self._exchange(axis, words, form)
            if reply.accepted or reply.data != "AGAIN":
                break
            self._clock.sleep(PAUSE)
        if not reply.accepted:
            raise DeviceRefused(
                self._name,
                f"it rejected the request: {REASONS.get(reply.data, 'a reason that this driver does not know')} "
                f"({reply.data})",
                request=words,
                reply=reply.raw,
                advice="Check the configuration against the device, and that no other program controls the device",
                state="The current move continues" if reply.busy else "Nothing has moved because of this request",
            )
        return reply

    def _exchange(self, axis: int, words: str, form: str) -> Reply:
        state = "An earlier move was started; the stage may be turning" if self._commanded else "Nothing has moved"
        identity = next(self._ids)
        request, meaning = encode(self._device, axis, identity, words), f"the reply to message {identity:02d}"
        return Reply.of(self._line.query(request, reply_form(self._device, axis, identity, form), meaning, state))
