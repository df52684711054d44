"""Check: what the doctor looked at, the verdict, what was found against what was expected, and what to do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType
from typing import Any

from drivers.errors import DeviceError


class Verdict(StrEnum):
    OK = "ok"
    WARNING = "warning"  # it works, with less room than one wants
    FAILED = "failed"  # a scan would fail, or lose frames
    NOT_APPLICABLE = "not applicable"
    CANNOT_CHECK = "cannot check"  # this machine does not tell


@dataclass(frozen=True)
class Check:
    """One result.

    Attributes:
        found, expected, advice: sentences or parts of them, for a human; empty where there is nothing to say.
        values: the numbers behind them, for a program; bytes, bytes/s, s.
    """

    name: str
    verdict: Verdict
    found: str
    expected: str = ""
    advice: str = ""
    values: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))


def of_error(name: str, error: DeviceError, expected: str, verdict: Verdict = Verdict.FAILED) -> Check:
    """What a device's refusal or silence comes to."""
    reply = f" It answered {error.reply!r}." if error.reply else ""
    found = f"{error.problem[:1].upper()}{error.problem[1:]}.{reply}"
    return Check(name, verdict, found, error.expected or expected, error.advice)
