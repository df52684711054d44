"""Rules that readers of scan files rely on, and findings where a file violates them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "info"]


@dataclass(frozen=True)
class Finding:
    """A finding of a rule. Severity "error": not fit for reconstruction or not a valid file; `rule`: name of the
    rule."""

    severity: Severity
    rule: str
    message: str
