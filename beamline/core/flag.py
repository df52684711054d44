"""Flag: what a check of the monitor says of a frame, which the event `flag` carries; finding: what a rule says of a
scan."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Literal

import numpy as np

PixelBox = tuple[int, int, int, int]
"""Pixels of a frame: (first row, row after the last, first column, column after the last)."""


class Level(StrEnum):
    INFO = "info"  # a fact about the scan; the frame is not marked in the file
    WARN = "warn"  # look at it when you have time
    ALARM = "alarm"  # the data are suffering now


@dataclass(frozen=True)
class Flag:
    """The finding of a check about one frame or several.

    Attributes:
        check: name of the check.
        level: how bad.
        frame: its number in the file, from 0; darks and flats count.
        score: the measured figure, in the check's unit.
        limit: the figure that it exceeds.
        advice: what it means and what to do.
        region: where in the frame; None: everywhere, or nowhere in particular.
        first: the first frame that it holds for, where that is not `frame`: some findings need several views. All are
            of its kind, without another between. Where a finding takes still more views, `frame` itself is earlier
            than the one at which it is found.
        from_region: where in the frame `first`; what it is of moved straight to `region`. None: `region` in `frame`
            alone is known.
    """

    check: str
    level: Level
    frame: int
    score: float
    limit: float
    advice: str
    region: PixelBox | None = None
    first: int | None = None
    from_region: PixelBox | None = None

    @property
    def frames(self) -> range:
        """Frames of the file that it applies to."""
        return range(self.frame if self.first is None else self.first, self.frame + 1)

    def regions(self) -> dict[int, PixelBox]:
        """Regions of its frames that show it, where they are known."""
        if self.region is None:
            return {}
        if self.from_region is None:
            return {self.frame: self.region}
        boxes = np.rint(np.linspace(self.from_region, self.region, len(self.frames))).astype(int).tolist()
        return {frame: tuple(box) for frame, box in zip(self.frames, boxes, strict=True)}

    def event_values(self) -> dict[str, Any]:
        """Values of the event `flag` by name."""
        return {name: value for name, value in vars(self).items() if name != "from_region" or value is not None}


Severity = Literal["error", "warning", "info"]


@dataclass(frozen=True)
class Finding:
    """What a rule finds in a scan or a file.

    Attributes:
        severity: "error": not fit for reconstruction, or not a valid file.
        rule: its name.
        message: in words, with what to do.
        frames: their rows in the file; empty: of all, or of none in particular.
        score, limit: the figure, and the limit that it violates; NaN without a figure.
    """

    severity: Severity
    rule: str
    message: str
    frames: tuple[int, ...] = ()
    score: float = math.nan
    limit: float = math.nan
