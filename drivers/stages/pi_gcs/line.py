"""The protocol of PI GCS 2.0: set commands, each followed by ERR?, queries, control bytes, numbers as text."""

from __future__ import annotations

import re
import threading
from fractions import Fraction

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.serial.line import Probe, line_to
from drivers.serial.line_reader import Framing
from drivers.stages.settings import Wiring

STOPPED = 10
NOT_ALLOWED_TO_MOVE = 5
UNKNOWN_COMMAND = 2

CHECK_MODEL = "Check that the controller belongs to the C-863 class and supports this command"
CHECK_AXIS = "Check that the command SAI? lists the axis that the configuration names"
CHECK_TRAVEL = "Compare the limits in the configuration with the controller's travel range (TMN?, TMX?)"
CHECK_SPEED = "Compare max_speed and acceleration in the configuration with what the controller allows"
HOME = "Search the reference first, and check that the servo is on"
LET_GO = "Release the controller from joystick, macro or another program"
WAIT = "Wait until the stage has stopped, or stop the stage"
OBSTACLE = "Find what blocked the stage (collision, load, cable, limit switch), then close and open the driver again"
LINE = "Check the cable and the baud rate"
SERVICE = "Switch the controller off and on; if the error persists, ask the vendor"

REFUSALS = {
    1: ("parameter syntax error", CHECK_MODEL),
    UNKNOWN_COMMAND: ("unknown command", CHECK_MODEL),
    3: ("command too long", LINE),
    4: ("the command could not be read", LINE),
    NOT_ALLOWED_TO_MOVE: ("a move is not possible: not referenced, or the servo is off", HOME),
    7: ("position out of limits", CHECK_TRAVEL),
    8: ("velocity out of limits", CHECK_SPEED),
    15: ("invalid axis identifier", CHECK_AXIS),
    17: ("parameter out of range", CHECK_SPEED),
    22: ("axis given twice", CHECK_AXIS),
    23: ("illegal axis", CHECK_AXIS),
    24: ("wrong number of parameters", CHECK_MODEL),
    25: ("invalid number format", CHECK_MODEL),
    26: ("parameter missing", CHECK_MODEL),
    27: ("soft limit out of range", CHECK_TRAVEL),
    31: ("the axis has no reference sensor", "Set the key `reference` to a limit switch that the stage has"),
    32: ("the axis has no limit switches", "Set the key `reference` to `switch`, if the stage has a reference switch"),
    34: ("the command is not allowed for this stage", CHECK_MODEL),
    35: ("there is no digital input", CHECK_MODEL),
    36: ("there is no such digital output", "Check trigger_line in the configuration"),
    39: ("invalid controller number", "Connect a single controller, not a daisy chain"),
    50: (
        "a reference move was tried while reference moves are disabled",
        "Enable reference moves on the controller (RON)",
    ),
    51: ("the axis is under joystick control", LET_GO),
    53: ("a dynamic move is in progress", WAIT),
    54: ("unknown parameter", CHECK_MODEL),
    56: ("wrong password", CHECK_MODEL),
    60: ("the parameter is protected", CHECK_MODEL),
    63: ("initialisation is running", "Wait some seconds and try again"),
    64: ("the parameter is read-only", CHECK_MODEL),
    83: ("the joystick is active", LET_GO),
    84: ("the motor is off", HOME),
    89: ("not allowed in the current motion mode", LET_GO),
    93: ("not allowed while the axis moves", WAIT),
    200: ("no stage is connected", "Check the stage's cable and the stage's name in the controller (CST?)"),
    201: ("the axis is not configured", "Check the stage's name in the controller (CST?)"),
    202: ("the axis is not there", CHECK_AXIS),
    203: ("the axis is not configured", "Check the stage's name in the controller (CST?)"),
    214: ("the position is unknown", HOME),
}
"""For each code, meaning and advice; for commands that were rejected and had no effect."""

MOTION = frozenset({45, 49, 333, 504, 505, 1024, 1025})
"""Events after which the axis may not be at its target; they are errors of the move in which they occur."""
EVENTS = {
    STOPPED: ("stopped by command", "Find who stopped the stage before you move it again"),
    45: (
        "the reference move failed",
        "Check the reference switch and its cable, and remove what is in the way of the stage",
    ),
    49: ("the move to the limit switch failed", "Check the limit switches, and remove what is in the way of the stage"),
    76: ("its interface buffer overran", LINE),
    301: ("its send buffer overflowed", LINE),
    304: ("its receive buffer overflowed", LINE),
    307: ("a communication timeout", LINE),
    308: ("a communication timeout", LINE),
    333: ("hardware error", SERVICE),
    504: ("following error too large", OBSTACLE),
    505: ("the sensor is invalid", SERVICE),
    1024: ("motion error: the position error grew too large and the servo switched itself off", OBSTACLE),
    1025: ("the motor output limit was reached", OBSTACLE),
}
"""For each code, meaning and advice; for events that do not belong to a command."""


def meaning(code: int) -> str:
    """Meaning of an error code in words, with the number; "" for 0."""
    if code == 0:
        return ""
    words, _ = (REFUSALS | EVENTS).get(code, ("an error that this driver does not know", ""))
    return f"error {code}, {words}"


def advice(code: int) -> str:
    _, what_to_do = (REFUSALS | EVENTS).get(code, ("", "Look the number up in the controller's manual"))
    return what_to_do


FRAMING = Framing(command_end=b"\n", line_end=b"\n", continued=" ")
PROBE = Probe("CSV?", r"\d+\.\d+")
NUMBER = r"([+-]?\d{1,12}(?:\.\d{0,20})?(?:[eE][+-]?\d{1,2})?)"
ANY_NUMBER = r"([+-]?\d{1,320}(?:\.\d{0,20})?(?:[eE][+-]?\d{1,3})?)"
"""Stages without end stops report limits as large as a number can be."""
DECIMALS = 12


def plain(value: Fraction) -> str:
    """A decimal number without exponent, rounded to 12 decimals, without needless zeros."""
    units = round(abs(value) * 10**DECIMALS)
    whole, rest = divmod(units, 10**DECIMALS)
    text = f"{whole}.{rest:0{DECIMALS}d}".rstrip("0").rstrip(".")
    return f"-{text}" if value < 0 and units else text


def is_rounding_of(reply: str, sent: str) -> bool:
    """Whether `reply` is the sent number, rounded to the decimals of the reply."""
    decimals = len(reply.partition(".")[2]) if "e" not in reply.lower() else DECIMALS
    return abs(Fraction(sent) - Fraction(reply)) <= Fraction(1, 2 * 10**decimals)


class GcsLine:
    """A controller and one of its axes. It can be used from several threads.

    `fault` keeps the last code of the error register until it is set to 0.

    Raises (here and in all methods):
        DeviceRefused: the controller rejects a command. DeviceError: another error code, or a reply of another form.
        DeviceTimeout: there is no reply.
    """

    def __init__(self, url: str, axis: str, wiring: Wiring, clock: Clock, name: str) -> None:
        self.fault = 0
        self.commanded = False
        """True if a move was started; error messages depend on it."""
        self._name, self._axis, self._key = name, axis, re.escape(axis) + " ?= ?"
        self._register = threading.RLock()
        self._serial = line_to(wiring, url, name, clock, PROBE, framing=FRAMING)

    def set(self, command: str) -> None:
        """Send a set command; raises an error if the register then contains a code."""
        self.raise_error(command, self.tell(command))

    def tell(self, command: str) -> int:
        """Send a set command; returns the code in the error register."""
        with self._register:
            self._serial.send(command)
            return self.read_error()

    def stop(self, command: str | bytes) -> None:
        """Send a stop (a command or control byte), even while another thread waits for a reply; then check its code.

        A stop sets its own code. Codes of earlier errors are also accepted.
        """
        self._serial.send(command)
        with self._register:
            code = self.read_error()
        if code in REFUSALS:
            self.raise_error(command if isinstance(command, str) else f"#{command[0]}", code)

    def read_error(self) -> int:
        """Read and clear the error register; a code other than 0 becomes `fault`."""
        code = int(self.ask("ERR?", r"\s*(-?\d{1,5})\s*", "an error code")[1])
        if code:
            self.fault = code
        return code

    def raise_error(self, command: str, code: int) -> None:
        """Raise the error for a code that a command left."""
        if code:
            refused = code in REFUSALS
            raise (DeviceRefused if refused else DeviceError)(
                self._name,
                f"{command.split()[0]} ended with {meaning(code)}",
                request=command,
                reply=str(code),
                expected="0, no error",
                advice=advice(code),
                state="The command had no effect" if refused and self.commanded else self._state(),
            )

    def ask(self, request: str | bytes, form: str, meant: str) -> re.Match[str]:
        """Send a query (text or control byte). Returns the match of its whole reply with `form`."""
        return self._serial.query(request, form, meant, self._state())

    def flag(self, query: str) -> bool:
        """Ask the axis a query whose answer is 0 or 1."""
        return self.ask(f"{query} {self._axis}", self._key + "([01])", f"{self._axis}=0 or {self._axis}=1")[1] == "1"

    def number(self, query: str, form: str = NUMBER) -> str:
        """Ask the axis a query whose answer is a number, and return it as written."""
        return self.ask(f"{query} {self._axis}", self._key + form, f"{self._axis}=number")[1]

    def parameter(self, number: str) -> str | None:
        """Read a parameter (SPA?).

        None if the controller does not know it, sets the error register and does not answer.
        """
        request = f"SPA? {self._axis} {number}"
        try:
            return self.ask(request, rf"{re.escape(self._axis)} \w+ ?= ?{NUMBER}", f"{self._axis} {number}=number")[1]
        except DeviceTimeout:
            before = self.fault
            if self.read_error() not in REFUSALS:
                raise
            self.fault = before
            return None

    def not_followed(self, command: str, reply: str, wanted: str) -> DeviceError:
        """The error for a read-back that differs from the set value."""
        return DeviceError(
            self._name,
            "it did not accept a setting",
            request=command,
            reply=reply,
            expected=wanted,
            advice="Check that no other program or person controls this controller, and check the cable",
            state=self._state(),
        )

    def wake(self) -> None:
        """End an incomplete command that another program may have left."""
        self._serial.send("")

    def close(self) -> None:
        """Close the port; calling again does nothing."""
        self._serial.close()

    def _state(self) -> str:
        return "An earlier move was started; the stage may be turning" if self.commanded else "Nothing has moved"
