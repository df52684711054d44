"""Frame: one detector image and what is known about it. A camera, a simulator and a file all yield Frames."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class FrameKind(IntEnum):
    """What a frame shows. The values are NXtomo's image_key (ALIGNMENT is ESRF's extension)."""

    PROJECTION = 0
    FLAT = 1
    DARK = 2
    INVALID = 3
    ALIGNMENT = -1


@dataclass(frozen=True, eq=False)
class Frame:
    """One image. It owns its memory: the one copy out of the camera's ring.

    Attributes:
        counts: uint16 [row, col].
        kind: what it shows.
        index: row in the file, counted over all frames of the scan from 0.
        trigger: index of the trigger pulse that exposed it, counted within its block of frames from 0.
        framestamp: the camera's own counter, -1 where there is none.
        angle: radians, the stage position at the trigger; NaN for no stage position (a dark with the stage anywhere).
        time: s since the Unix epoch, at the trigger.
        exposure: s.
    """

    counts: NDArray[np.uint16]
    kind: FrameKind
    index: int
    trigger: int
    framestamp: int
    angle: float
    time: float
    exposure: float
