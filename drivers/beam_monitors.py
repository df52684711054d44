"""Beam monitors that read the intensity as a number in a text, from a serial line, a web page or a file."""

from __future__ import annotations

import http.client
import math
import re
import urllib.error
import urllib.request
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol
from urllib.parse import urlsplit

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.base.protocols import BeamReading
from drivers.serial.line import LineRules, Probe, SerialLine
from drivers.serial.line_reader import Framing

QUERY = "READ?"
PATTERN = r"^\s*([+-]?[\d.]+(?:[eE][+-]?\d+)?)"


@dataclass(frozen=True)
class ElectrometerQuery:
    """Query of an electrometer, and the form of its reply.

    Attributes:
        query: command that requests a reading. It must have no side effects, because it is also used to probe the line
            (see `SerialLine`).
        pattern: regular expression that every reply must contain. If a reply does not contain it, the line counts as
            disturbed.
        setup: commands without a reply, sent once before the first query.
        line_end: line end of commands and replies.
    """

    query: str = QUERY
    pattern: str = PATTERN
    setup: Sequence[str] = ()
    line_end: bytes = b"\r\n"


_USUAL = ElectrometerQuery()


class SerialSource:
    """Implements `drivers.beam_monitors.TextSource` over a serial line.

    Args:
        url: pyserial URL.
        timeout, baudrate, transcript: see `SerialLine`.

    Raises:
        DeviceError: the port does not open. DeviceRefused: the query is empty.
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
            LineRules(Probe(self.request, self._form), framing=Framing(reading.line_end, reading.line_end), text=False),
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


MOST_BYTES = 1 << 20  # largest number of bytes read from a page; the number must be in them
_PIECE = 1 << 14


class PageSource:
    """Implements `drivers.beam_monitors.TextSource` over http, https or file.

    No proxy is used: the page is in the facility's own network.

    Args:
        url: http://..., https://... or file:///...
        timeout: time limit in s for the whole page, and for each wait on the network.

    Raises:
        DeviceRefused: the URL is not of one of these kinds.
    """

    def __init__(self, url: str, clock: Clock, *, timeout: float = 2.0, name: str = "beam monitor") -> None:
        if problem := url_problem(url):
            raise DeviceRefused(name, problem, state="Nothing was asked")
        self.request = url
        self._name, self._clock, self._timeout = name, clock, timeout
        self._opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))

    def text(self) -> str:
        """The text of the page, at most its first MOST_BYTES bytes. Raises DeviceTimeout, DeviceError."""
        deadline = self._clock.now() + self._timeout
        try:
            with self._opener.open(self.request, timeout=self._timeout) as page:
                charset = page.headers.get_content_charset() or "utf-8"
                data = bytearray()
                # read1 returns the bytes received so far; `read` would wait for ever on a server that sends slowly.
                while len(data) < MOST_BYTES and (piece := getattr(page, "read1", page.read)(_PIECE)):
                    data += piece
                    if self._clock.now() > deadline:
                        raise TimeoutError("the page did not end in time")
        except urllib.error.HTTPError as error:
            error.close()
            raise self._error(DeviceError, f"the server answered {error.code} {error.reason}") from error
        except TimeoutError as error:
            raise self._error(DeviceTimeout, f"no whole page within {self._timeout:g} s") from error
        except urllib.error.URLError as error:
            if isinstance(error.reason, TimeoutError):
                raise self._error(DeviceTimeout, f"no whole page within {self._timeout:g} s") from error
            raise self._error(DeviceError, f"the page cannot be read ({error.reason})") from error
        except (OSError, http.client.HTTPException) as error:
            raise self._error(DeviceError, f"the page cannot be read ({error or type(error).__name__})") from error
        try:
            return data.decode(charset, errors="replace")
        except LookupError:  # Python does not know the charset; digits are ASCII in nearly every charset
            return data.decode("ascii", errors="replace")

    def close(self) -> None:
        """Does nothing, because no connection stays open between readings."""

    def _error(self, kind: type[DeviceError], problem: str) -> DeviceError:
        return kind(
            self._name,
            problem,
            request=self.request,
            advice="Check the address in the configuration, the network, and that the page opens in a browser",
        )


def url_problem(url: str) -> str:
    """The reason why a URL cannot be read; "" if it can be read."""
    try:
        parts = urlsplit(url)
        legal = parts.scheme == "file" or (parts.scheme in ("http", "https") and bool(parts.hostname))
    except ValueError:
        legal = False
    return (
        ""
        if legal
        else f"{url!r} is not the address of a page; expected http://host/..., https://host/... or file:///..."
    )


OVERFLOW = 9.9e37
"""SCPI instruments send 9.9e37 for "over range" and 9.91e37 for "not a number" (SCPI-99, section 7.2.1)."""
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_SHOWN = 200  # largest number of characters of the text in an error


class TextSource(Protocol):
    """A source of a text that contains the number: an instrument or a web page."""

    request: str
    """The query or URL, for error messages."""

    def text(self) -> str:
        """The current text. Raises DeviceTimeout, DeviceError."""

    def close(self) -> None: ...


class TextBeamMonitor:
    """Implements `drivers.base.protocols.BeamMonitor` over a source of text.

    Args:
        pattern: regular expression, searched in the text; its first group is the number.
        unit: unit of the reading, written to the file.
        scale: factor from the number to `unit`.

    Raises:
        DeviceRefused: the pattern has no group, or the scale is 0 or not finite.
    """

    def __init__(
        self,
        source: TextSource,
        clock: Clock,
        *,
        pattern: str,
        unit: str,
        scale: float = 1.0,
        name: str = "beam monitor",
    ) -> None:
        self.name = name
        if problem := pattern_problem(pattern):
            raise DeviceRefused(name, problem, state="Nothing was asked")
        if not math.isfinite(scale) or scale == 0:
            raise DeviceRefused(name, f"the scale {scale} is not valid", expected="a number that is not zero")
        self._source, self._clock, self._unit, self._scale = source, clock, unit, scale
        self._pattern = re.compile(pattern)

    def reading(self) -> BeamReading:
        """Read the source once.

        Raises DeviceTimeout, or DeviceError if the text contains no number or one that is over range.
        """
        text = self._source.text()
        time = self._clock.now()
        match = self._pattern.search(text)
        number = "" if match is None else match[1] or ""
        if not _NUMBER.fullmatch(number):
            raise self._error("the answer contains no number", text)
        value = float(number)
        if abs(value) >= OVERFLOW:
            raise self._error("the instrument is over range, or has no valid reading", text)
        return BeamReading(value * self._scale, self._unit, time)

    def close(self) -> None:
        self._source.close()

    def _error(self, problem: str, text: str) -> DeviceError:
        return DeviceError(
            self.name,
            problem,
            request=self._source.request,
            reply=text[:_SHOWN].strip(),
            expected=f"a number in the group of {self._pattern.pattern!r}",
            advice="Check the instrument's range and state, and the pattern in the configuration",
        )


def pattern_problem(pattern: str) -> str:
    """The reason why a pattern cannot be used; "" if it can be used."""
    try:
        groups = re.compile(within_a_line(pattern)).groups
    except re.error as error:
        return f"the pattern {pattern!r} is not a regular expression ({error})"
    return "" if groups else f"the pattern {pattern!r} has no group (...) around the number"


def within_a_line(pattern: str) -> str:
    """A pattern for a whole line that contains a match of `pattern`."""
    return f".*?(?:{pattern}).*"
