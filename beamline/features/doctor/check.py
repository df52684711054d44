"""Check: the result of one check of the doctor: verdict, what was observed, what was expected, what to do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType
from typing import Any

from drivers.base.errors import DeviceError


class Grade(StrEnum):
    OK = "ok"
    WARNING = "warning"  # it works, with a small margin
    FAILED = "failed"  # a scan would fail, or lose frames
    NOT_APPLICABLE = "not applicable"
    CANNOT_CHECK = "cannot check"  # this machine does not report it


@dataclass(frozen=True)
class Diagnosis:
    """Result of one check.

    Attributes:
        observed, expected, advice: sentences or parts of them, for people; may be empty.
        values: the same as numbers, for programs; bytes, bytes/s, s.
    """

    name: str
    verdict: Grade
    observed: str
    expected: str = ""
    advice: str = ""
    values: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))


def of_error(name: str, error: DeviceError, expected: str, verdict: Grade = Grade.FAILED) -> Diagnosis:
    """Result of a check that failed with a device error."""
    reply = f" It answered {error.reply!r}." if error.reply else ""
    observed = f"{error.problem[:1].upper()}{error.problem[1:]}.{reply}"
    return Diagnosis(name, verdict, observed, error.expected or expected, error.advice)
