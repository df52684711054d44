"""SerialSource: a beam monitor's text from an electrometer on a serial line, one line in reply to a query.

Not tested on an instrument. The defaults are meant for the Keithley 6485 picoammeter (`READ?` answers
`+1.0427E-12A,+2.345E+02,+0.000E+00`: current, time, status; 9600 baud; line end as set on its front panel). They were
not checked against its manual: check them on yours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceRefused
from drivers.beam_monitors.reading import within_a_line
from drivers.serial.line import LineRules, Probe, SerialLine
from drivers.serial.line_reader import Framing

QUERY = "READ?"
PATTERN = r"^\s*([+-]?[\d.]+(?:[eE][+-]?\d+)?)"


@dataclass(frozen=True)
class ElectrometerQuery:
    """How an electrometer is read.

    Attributes:
        query: command that asks for a reading; it must have no side effects, since it is also the line's probe (see
            `SerialLine`).
        pattern: regular expression that every reply contains; any other reply counts as a disturbed line.
        setup: commands without a reply, sent once before the first query.
        line_end: of commands and replies.
    """

    query: str = QUERY
    pattern: str = PATTERN
    setup: Sequence[str] = ()
    line_end: bytes = b"\r\n"


_USUAL = ElectrometerQuery()


class SerialSource:
    """Implements `drivers.beam_monitors.reading.TextSource` over a serial line.

    Args:
        url: pyserial URL.
        timeout, baudrate, transcript: see `SerialLine`.

    Raises:
        DeviceError: the port does not open. DeviceRefused: an empty query.
    """

    def __init__(
        self,
        url: str,
        clock: Clock,
        reading: ElectrometerQuery = _USUAL,
        *,
        timeout: float = 2.0,
        baudrate: int = 9600,
        name: str = "beam monitor",
        transcript: Path | None = None,
    ) -> None:
        self.request = reading.query
        self._form = within_a_line(reading.pattern)
        if not self.request:
            raise DeviceRefused(name, "the query is empty", state="Nothing was sent")
        self._line = SerialLine(
            url,
            LineRules(Probe(self.request, self._form), framing=Framing(reading.line_end, reading.line_end)),
            clock,
            device=name,
            timeout=timeout,
            baudrate=baudrate,
            transcript=transcript,
        )
        try:
            for command in reading.setup:
                self._line.send(command)
        except DeviceError:
            self.close()
            raise

    def text(self) -> str:
        """The reply to the query. Raises DeviceTimeout, DeviceError."""
        return self._line.query(self.request, self._form, "a line with a number")[0]

    def close(self) -> None:
        self._line.close()
