"""TextBeamMonitor: reads the beam intensity as the number that a regular expression finds in a text."""

from __future__ import annotations

import math
import re
from typing import Protocol

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceRefused
from drivers.base.protocols import BeamReading

OVERFLOW = 9.9e37
"""SCPI instruments send 9.9e37 for "over range" and 9.91e37 for "not a number" (SCPI-99, section 7.2.1)."""
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_SHOWN = 200  # Characters of the text that an error shows


class TextSource(Protocol):
    """A source of a text that holds the number: an instrument or a web page."""

    request: str
    """The query or URL, for error messages."""

    def text(self) -> str:
        """The current text. Raises DeviceTimeout, DeviceError."""

    def close(self) -> None: ...


class TextBeamMonitor:
    """Implements `drivers.base.protocols.BeamMonitor` over a source of text.

    Args:
        pattern: regular expression, searched in the text; its first group is the number.
        unit: of the reading, written to the file.
        scale: factor from the number to `unit`.

    Raises:
        DeviceRefused: a pattern without a group, or a scale that is 0 or not finite.
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
        """Read the source once. Raises DeviceTimeout, or DeviceError: no number, or over range."""
        text = self._source.text()
        time = self._clock.now()
        match = self._pattern.search(text)
        found = "" if match is None else match[1] or ""
        if not _NUMBER.fullmatch(found):
            raise self._error("the answer holds no number", text)
        value = float(found)
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
            expected=f"a number where {self._pattern.pattern!r} has its group",
            advice="Check the instrument's range and state, and the pattern in the configuration",
        )


def pattern_problem(pattern: str) -> str:
    """Reason for which a pattern cannot be used; "" if it can."""
    try:
        groups = re.compile(within_a_line(pattern)).groups
    except re.error as error:
        return f"the pattern {pattern!r} is not a regular expression ({error})"
    return "" if groups else f"the pattern {pattern!r} has no group (...) around the number"


def within_a_line(pattern: str) -> str:
    """A pattern for a whole line that contains a match of `pattern`."""
    return f".*?(?:{pattern}).*"
