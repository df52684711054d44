"""Numbers of steps and Gaussians for the quality presets, and times as text."""

from __future__ import annotations

import math
from dataclasses import dataclass

from recon.base.choices import Quality

MOST_STEPS = 1000
"""Largest number of steps of a fit with a time limit. In four scans, measured and simulated, more steps fitted the
noise."""


@dataclass(frozen=True)
class Preset:
    """Settings of a Gaussian fit for one quality preset.

    Attributes:
        share: number of Gaussians at the start, relative to the default number for the volume.
    """

    steps: int
    share: float


PRESETS: dict[Quality, Preset] = {"preview": Preset(125, 0.5), "standard": Preset(400, 1.0), "best": Preset(1500, 1.0)}


def parse_budget(text: str) -> float:
    """Convert "30s", "2m", "1.5h" or a plain number to seconds.

    Raises:
        ValueError: the text has another form, or the time is not positive and finite.
    """
    units = {"s": 1.0, "m": 60.0, "h": 3600.0}
    number = text.strip()
    unit = units.get(number[-1:].lower())
    try:
        seconds = float(number if unit is None else number[:-1]) * (unit or 1.0)
    except ValueError:
        seconds = math.nan
    if not (math.isfinite(seconds) and seconds > 0):
        raise ValueError(f"{text!r} is not a time; write a positive number with s, m or h, such as 30s, 2m or 1h")
    return seconds


def duration_text(seconds: float) -> str:
    """A time as text in s, min or h."""
    if seconds < 100:
        return f"{seconds:.3g} s"
    return f"{seconds / 60:.3g} min" if seconds < 6000 else f"{seconds / 3600:.3g} h"
