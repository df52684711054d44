"""Flag: what a check says about a frame, and ScanContext: what all checks may know about the scan."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray


class Level(StrEnum):
    WARN = "warn"  # look at it when you have time
    ALARM = "alarm"  # the data are suffering now


@dataclass(frozen=True)
class Flag:
    """A check's finding.

    Attributes:
        check: name of the check.
        level: how bad.
        view: the frame's row in the file.
        score: the measured figure, in the unit that the check's Limits state.
        limit: the figure that it exceeds.
        advice: what it means and what to do.
    """

    check: str
    level: Level
    view: int
    score: float
    limit: float
    advice: str


@dataclass(frozen=True, eq=False)
class ScanContext:
    """What does not depend on the frame, and the references seen so far.

    Attributes:
        saturation: the count from which a pixel is saturated.
        pixels: of a frame.
        period: s between the triggers of a fly scan; None where frames come when the stage is ready (step scan).
        pass_starts: triggers at which a new pass of a fly scan begins, after any pause.
        dark, flat: float32 [preview row, preview col] mean of the latest group of darks and of flats, None before any.
        flat_exposure: s of these flats, which may have an exposure of their own.
    """

    saturation: float
    pixels: int
    period: float | None = None
    pass_starts: frozenset[int] = frozenset({0})
    dark: NDArray[np.float32] | None = None
    flat: NDArray[np.float32] | None = None
    flat_exposure: float = math.nan
