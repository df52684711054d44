"""SerialSource: a beam monitor's text from an electrometer on a serial line, one line in reply to a query.

Not tested on an instrument. The defaults are meant for the Keithley 6485 picoammeter (`READ?` answers
`+1.0427E-12A,+2.345E+02,+0.000E+00`: current, time, status; 9600 baud; line end as set on its front panel). They were
not checked against its manual: check them on yours.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceRefused
from drivers.beam_monitors.reading import within_a_line
from drivers.serial.line import Probe, SerialLine
from drivers.serial.line_reader import Framing

QUERY = "READ?"
PATTERN = r"^\s*([+-]?[\d.]+(?:[eE][+-]?\d+)?)"


class SerialSource:
    """Implements `drivers.beam_monitors.reading.TextSource` over a serial line.

    Args:
        url: pyserial URL.
        query: command that asks for a reading; it must have no side effects, since it is also the line's probe (see
            `SerialLine`).
        pattern: regular expression that every reply contains; any other reply counts as a disturbed line.
        setup: commands without a reply, sent once before the first query.
        line_end: of commands and replies.
        transcript: see `SerialLine`.

    Raises:
        DeviceError: the port does not open. DeviceRefused: an empty query.
    """

    def __init__(
        self,
        url: str,
        clock: Clock,
        *,
        query: str = QUERY,
        pattern: str = PATTERN,
        setup: Sequence[str] = (),
        timeout: float = 2.0,
        baudrate: int = 9600,
        line_end: bytes = b"\r\n",
        name: str = "beam monitor",
        transcript: Path | None = None,
    ) -> None:
        self.request = query
        self._form = within_a_line(pattern)
        if not query:
            raise DeviceRefused(name, "the query is empty", state="Nothing was sent")
        self._line = SerialLine(
            url,
            device=name,
            probe=Probe(query, self._form),
            clock=clock,
            timeout=timeout,
            baudrate=baudrate,
            framing=Framing(line_end, line_end),
            transcript=transcript,
        )
        try:
            for command in setup:
                self._line.send(command)
        except DeviceError:
            self.close()
            raise

    def text(self) -> str:
        """The reply to the query. Raises DeviceTimeout, DeviceError."""
        return self._line.query(self.request, self._form, "a line with a number")[0]

    def close(self) -> None:
        self._line.close()
