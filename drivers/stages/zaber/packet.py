"""Zaber ASCII packets from the host's side: commands with checksum and message id, replies, and the meaning of words.

Protocol: Zaber's ASCII protocol version 2 as the vendor's library zaber-motion sends and accepts it. Meanings of flags
and reasons in our words, after zaber-motion and ArduinoZaberMaster.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Self


@dataclass(frozen=True)
class Meaning:
    """Meaning of a flag or reason, and advice."""

    text: str
    advice: str


FAULTS = {
    "FF": Meaning("critical system error", "Switch the controller off and on; if it stays, ask the vendor"),
    "FN": Meaning("peripheral not supported", "Check which stage is plugged into the controller"),
    "FZ": Meaning("peripheral inactive", "Plug the stage in again and activate it"),
    "FH": Meaning("emergency stop of the hardware", "Release the emergency stop, then enable the driver"),
    "FV": Meaning("supply voltage out of range, driver off", "Check the power supply"),
    "FO": Meaning("driver disabled", "Find who disabled it, then `driver enable` with the vendor's software"),
    "FC": Meaning("inrush current too high", "Check the motor's cable and the power supply"),
    "FM": Meaning("motor too hot", "Let it cool down; take a lower speed or load"),
    "FD": Meaning(
        "driver disabled", "Find the cause of an earlier fault, then `driver enable` with the vendor's software"
    ),
    "FQ": Meaning("encoder error, the position may be wrong", "Check the encoder's cable, then search the reference"),
    "FI": Meaning("encoder index error", "Search the reference again; check the encoder's cable"),
    "FA": Meaning("analogue encoder out of step", "Search the reference again; check the encoder's cable"),
    "FR": Meaning("overdrive limit", "Take a lower acceleration or load"),
    "FS": Meaning("stalled and stopped", "Find what blocks the stage; take a lower speed, acceleration or load"),
    "FB": Meaning("stream bounds", "Find who runs a stream on this controller"),
    "FP": Meaning("left its path", "Find who runs an interpolated move on this controller"),
    "FE": Meaning("limit error", "Find why the stage ran into a limit, then search the reference"),
    "FT": Meaning("twisted too far", "Turn the cables back"),
}
"""Flags of a fault; the driver may be off."""
ENDINGS = {
    "WL": Meaning(
        "a limit switch came where none was expected", "Check travel limits and cables, search the reference"
    ),
    "WV": Meaning("supply voltage out of range", "Check the power supply"),
    "WT": Meaning("controller hot", "Let it cool down"),
    "WS": Meaning("stalled and recovered", "Take a lower speed, acceleration or load"),
    "WM": Meaning("displaced while it stood", "Find what pushed the stage; search the reference"),
    "NC": Meaning("moved by its knob", "Leave the knob alone while a scan runs"),
    "NI": Meaning("movement interrupted", "Find who stopped it"),
}
"""Flags that can explain why a move ended early, beside those of faults."""
INTERRUPTED = "NI"
"""The flag that every stop before the end of a move leaves, also a stop of our own: the stage is where it counts."""
SLIPPED = frozenset({"WL", "WS", "WM", "NC"})
"""Flags after which the stage may not be where its counts say: beside faults, errors of the move in which they come."""
LOST = frozenset({"FS", "FQ", "FI", "FA", "FE"})
"""Flags of faults after which the same holds."""
UNREFERENCED = frozenset({"WR", "WH"})  # Flags of an axis that does not know its reference
REASONS = {
    "AGAIN": "it asks to repeat, again and again",
    "AXISONLY": "this is asked of an axis only",
    "BADAXIS": "there is no such axis",
    "BADCOMMAND": "it does not know this command or setting",
    "BADDATA": "a value is missing or out of its range",
    "BADMESSAGEID": "the message id is none",
    "DEVICEONLY": "this is asked of the device only",
    "DRIVERDISABLED": "its driver is disabled",
    "FULL": "its memory is full",
    "INACTIVE": "its peripheral is inactive",
    "NOACCESS": "the access level forbids it",
    "NOTSUPPORTED": "its peripheral is not supported",
    "PARKED": "it is parked",
    "REMOTE": "it is under remote control by others",
    "STATUSBUSY": "it does not do that while it moves",
    "SYSTEMERROR": "it failed inside",
}


@dataclass(frozen=True)
class Reply:
    """A reply to one command. `flag` is the gravest warning, "" without one; `data` is "0" if there are no data."""

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
    """A command packet without its line end."""
    body = f"{device} {axis} {identity:02d} {words}".rstrip()
    return f"/{body}:{lrc(body)}"


def damage(line: str, *, must_have_checksum: bool) -> str:
    """Fault of a received line by its checksum; "" if it is good.

    Only replies, alerts and information carry a checksum; other lines pass.
    """
    if line[:1] not in ("@", "!", "#"):
        return ""
    body, colon, checksum = line[1:].partition(":")
    if not colon:
        return "it has no checksum" if must_have_checksum and line[0] == "@" else ""
    if not body.isascii() or checksum != lrc(body):
        return (
            f"its checksum is {checksum!r} and not {lrc(body)!r}" if body.isascii() else "it has bytes that are no text"
        )
    return ""


def reply_form(device: int, axis: int, identity: int, data: str) -> str:
    """Regular expression of the reply to a command; `data` is the expression for the data of an accepted command."""
    head = rf"@0?{device} {axis} {identity:02d} (?:(OK)|RJ) (BUSY|IDLE) ([A-Z-]{{2}})"
    return rf"{head} ((?(1)(?:{data})|\w+))(?::[0-9A-F]{{2}})?"


def passed_over_form(identity: int) -> str:
    """Regular expression of lines to skip: alerts, information, echoes, empty lines, and replies to commands with this
    id.
    """
    return rf"|[!#/].*|@\d\d \d {identity:02d} .*"


def meaning_of(flags: tuple[str, ...]) -> Meaning | None:
    """The gravest of the flags that is a fault or ends moves; None without one."""
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
