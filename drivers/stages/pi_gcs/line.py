"""The dialogue of PI GCS 2.0: set commands and the error register after each, queries, control bytes, numbers as text.

Set commands are not answered: each is followed by ERR?, which returns its error code and clears the register.
"""

from __future__ import annotations

import re
import threading
from fractions import Fraction

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.serial.line import Probe
from drivers.serial.line_reader import Framing
from drivers.stages.pi_gcs.errors import REFUSALS, advice, meaning
from drivers.stages.settings import Wiring

FRAMING = Framing(command_end=b"\n", line_end=b"\n", continued=" ")
PROBE = Probe("CSV?", r"\d+\.\d+")
NUMBER = r"([+-]?\d{1,12}(?:\.\d{0,20})?(?:[eE][+-]?\d{1,2})?)"
ANY_NUMBER = r"([+-]?\d{1,320}(?:\.\d{0,20})?(?:[eE][+-]?\d{1,3})?)"
"""Endless stages give limits as large as a number can be."""
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
    """A controller and the used one of its axes. `fault` keeps the register's last code until it is set to 0. Safe from
    several threads.

    Raises (here and in all methods):
        DeviceRefused: the controller refuses a command. DeviceError: another code, or a reply of another form.
        DeviceTimeout: no reply.
    """

    def __init__(self, url: str, axis: str, wiring: Wiring, clock: Clock, name: str) -> None:
        self.fault = 0
        self.commanded = False
        """Whether a move has started; error messages depend on it."""
        self._name, self._axis, self._key = name, axis, re.escape(axis) + " ?= ?"
        self._register = threading.RLock()
        self._serial = wiring.line(url, name, clock, PROBE, framing=FRAMING)

    def set(self, command: str) -> None:
        """Send a set command; raises if the register then has a code."""
        self.judge(command, self.tell(command))

    def tell(self, command: str) -> int:
        """Send a set command; returns the register's code."""
        with self._register:
            self._serial.send(command)
            return self.read_error()

    def stop(self, command: str | bytes) -> None:
        """Send a stop, as a command or control byte, even while another thread asks; then check that it was understood.

        A stop sets its own code; codes of earlier errors are accepted, too.
        """
        self._serial.send(command)
        with self._register:
            code = self.read_error()
        if code in REFUSALS:
            self.judge(command if isinstance(command, str) else f"#{command[0]}", code)

    def read_error(self) -> int:
        """Read and clear the error register; a code other than 0 becomes `fault`."""
        code = int(self.ask("ERR?", r"\s*(-?\d{1,5})\s*", "an error code")[1])
        if code:
            self.fault = code
        return code

    def judge(self, command: str, code: int) -> None:
        """Raises the error for a code after a command."""
        if code:
            refused = code in REFUSALS
            raise (DeviceRefused if refused else DeviceError)(
                self._name,
                f"{command.split()[0]} ended with {meaning(code)}",
                request=command,
                reply=str(code),
                expected="0, no error",
                advice=advice(code),
                state="That command did nothing" if refused and self.commanded else self._state(),
            )

    def ask(self, request: str | bytes, form: str, meant: str) -> re.Match[str]:
        """Send a query, a text or a control byte. Returns the match of its whole reply with `form`."""
        return self._serial.query(request, form, meant, self._state())

    def flag(self, query: str) -> bool:
        """A query of the axis that is answered by 0 or 1."""
        return self.ask(f"{query} {self._axis}", self._key + "([01])", f"{self._axis}=0 or {self._axis}=1")[1] == "1"

    def number(self, query: str, form: str = NUMBER) -> str:
        """A query of the axis that is answered by a number, as it is written."""
        return self.ask(f"{query} {self._axis}", self._key + form, f"{self._axis}=number")[1]

    def parameter(self, number: str) -> str | None:
        """SPA?; None for an unknown parameter: the controller then does not answer, and sets the error register."""
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
            "a setting was not taken",
            request=command,
            reply=reply,
            expected=wanted,
            advice="Check that no other program or person drives this controller, and the cable",
            state=self._state(),
        )

    def wake(self) -> None:
        """End an incomplete command that another program may have left."""
        self._serial.send("")

    def close(self) -> None:
        """Free the port; a second time does nothing."""
        self._serial.close()

    def _state(self) -> str:
        return "A move was started before; the stage may be turning" if self.commanded else "Nothing has moved"


class GcsOutput:
    """Implements `drivers.base.protocols.DigitalOutput` on the line of an open stage.

    `DIO?` reads the inputs [from memory: of GCS controllers in general], so that an output cannot be read back.
    """

    def __init__(self, line: GcsLine, number: int, name: str) -> None:
        self.name = name
        self._line, self._number = line, number

    def set(self, high: bool) -> None:
        self._line.set(f"DIO {self._number} {int(high)}")

    def get(self) -> None:
        return None
