"""Useful lengths of methods, presets, and times as text."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from recon.base.choices import Quality
from recon.base.empirical import DEFAULT_STEPS

MODEL_STEPS = 50
"""Of a fit whose volume voxels make. Without: no Gaussians beside such a volume."""


@dataclass(frozen=True)
class UsefulSteps:
    """Steps of a method between which the volume becomes better, on four measured and simulated scans.

    Attributes:
        setting: that counts them; empty for a method without steps.
        least: from which the volume is nearer to the truth than FBP.
        most: beyond which further steps fit the noise.
    """

    setting: str = ""
    least: int = 1
    most: int = 1


USEFUL: Mapping[str, UsefulSteps] = {
    "fbp": UsefulSteps(),
    "os-sirt-tv": UsefulSteps("iterations", 10, 40),
    "r2": UsefulSteps("steps", 125, 1000),
    "fista-tv": UsefulSteps("iterations", 5, 40),
}
"""By method, the preferred one last: up to 7.1, 8.4 and 8.1 dB above FBP, means of four scans; the last two are level.
Of pixels binned by two, all are 1.7 to 3.9 dB behind FBP of all pixels."""


@dataclass(frozen=True)
class Preset:
    """Settings of a fit for one of the quality levels.

    Attributes:
        share: Gaussians at the start, relative to the default number for the volume.
    """

    steps: int
    share: float


PRESETS: dict[Quality, Preset] = {"preview": Preset(125, 0.5), "standard": Preset(400, 1.0), "best": Preset(1500, 1.0)}


def best_steps(method: str) -> int:
    """Steps of this method beyond which further ones fit the noise."""
    return USEFUL[method].most if method in USEFUL else DEFAULT_STEPS


def parse_budget(text: str) -> float:
    """Parse "30s", "2m", "1.5h" or a bare number to seconds.

    Raises:
        ValueError: for anything else, and for a time that is not positive and finite.
    """
    units = {"s": 1.0, "m": 60.0, "h": 3600.0}
    number = text.strip()
    unit = units.get(number[-1:].lower())
    try:
        seconds = float(number if unit is None else number[:-1]) * (unit or 1.0)
    except ValueError:
        seconds = math.nan
    if not (math.isfinite(seconds) and seconds > 0):
        raise ValueError(f"{text!r} is not a time: expected a positive number with s, m or h, such as 30s, 2m or 1h")
    return seconds


def duration_text(seconds: float) -> str:
    """A time as text: s, min or h."""
    if seconds < 100:
        return f"{seconds:.3g} s"
    return f"{seconds / 60:.3g} min" if seconds < 6000 else f"{seconds / 3600:.3g} h"
