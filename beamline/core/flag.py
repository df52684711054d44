"""`Flag`: the finding of a check of the monitor about a frame (in the event `flag`). `Finding`: the finding of a rule
about a scan or a file."""

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
    WARN = "warn"  # check it when you have time
    ALARM = "alarm"  # data are being damaged or lost now


@dataclass(frozen=True)
class Flag:
    """The finding of a check of the monitor about one frame, or about several frames.

    Attributes:
        check: name of the check.
        level: how serious it is, see `Level`.
        frame: number of the frame in the file, counted from 0 over all frames, also darks and flats.
        score: the measured value, in the check's unit.
        limit: the limit that the value exceeds.
        advice: what the finding means and what to do.
        region: part of the frame that shows the fault; None: the whole frame, or no particular part.
        first: first frame that the finding applies to, if it applies to several frames; `frame` is the last one. All
            frames between them are of the same kind. `frame` may be earlier than the frame at which the check noticed
            the fault, because some checks also need later projections.
        from_region: part of the frame `first` that shows a moving object. From there the object moved in a straight
            line to `region`. None: only its position `region` in `frame` is known.
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
        """Frames of the file that the finding applies to."""
        return range(self.frame if self.first is None else self.first, self.frame + 1)

    def regions(self) -> dict[int, PixelBox]:
        """For each frame with a known region, the part of the frame that shows the fault."""
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
    """The finding of a rule about a scan or a file.

    Attributes:
        severity: "error": the scan cannot be reconstructed, or the file is not valid.
        rule: name of the rule.
        message: what was found and what to do.
        frames: rows of the frames in the file; empty: all frames, or no particular frame.
        score, limit: the measured value, and the limit that the value violates. NaN: nothing was measured.
    """

    severity: Severity
    rule: str
    message: str
    frames: tuple[int, ...] = ()
    score: float = math.nan
    limit: float = math.nan
