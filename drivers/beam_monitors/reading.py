"""Beam monitor: how much beam there is, as the number that a pattern finds in what a source says."""

from __future__ import annotations

import math
import re
from typing import Protocol

from drivers.clock import Clock
from drivers.errors import DeviceError, DeviceRefused
from drivers.protocols import BeamReading

OVERFLOW = 9.9e37
"""SCPI instruments answer this for "over range" and 9.91e37 for "not a number" (SCPI-99, section 7.2.1)."""
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_TOLD = 200
"""Characters of a source's text that an error shows."""


class TextSource(Protocol):
    """Whatever can be asked for a text that holds the number: an instrument, a page."""

    request: str
    """What is asked, for errors."""

    def text(self) -> str:
        """The present text. Raises DeviceTimeout, DeviceError."""
        ...

    def close(self) -> None: ...


class TextBeamMonitor:
    """Implements `drivers.protocols.BeamMonitor` over a source of text.

    Args:
        pattern: regular expression; its first group is the number, wherever it first stands in the text.
        unit: of the reading, for the record.
        scale: what the number is multiplied by to be in `unit`.

    Raises:
        DeviceRefused: a pattern without a group, or a scale that is none.
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
            raise DeviceRefused(name, f"a scale of {scale} is none", expected="a number that is not zero")
        self._source, self._clock, self._unit, self._scale = source, clock, unit, scale
        self._pattern = re.compile(pattern)

    def reading(self) -> BeamReading:
        """Ask the source. Raises DeviceTimeout, or DeviceError: no number, over range, or not finite."""
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
            reply=text[:_TOLD].strip(),
            expected=f"a number where {self._pattern.pattern!r} has its group",
            advice="Check the instrument's range and state, and the pattern in the configuration",
        )


def pattern_problem(pattern: str) -> str:
    """Why a pattern cannot be used; empty where it can."""
    try:
        groups = re.compile(within_a_line(pattern)).groups
    except re.error as error:
        return f"the pattern {pattern!r} is no regular expression ({error})"
    return "" if groups else f"the pattern {pattern!r} has no group (...) around the number"


def within_a_line(pattern: str) -> str:
    """The form of a whole line that holds what `pattern` finds."""
    return f".*?(?:{pattern}).*"
