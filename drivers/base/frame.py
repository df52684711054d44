"""Frame: one detector image with its metadata; cameras, simulators and files all deliver Frames."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class FrameKind(IntEnum):
    """Kind of image. The values are those of NXtomo's image_key (ALIGNMENT is an extension by the ESRF)."""

    PROJECTION = 0
    FLAT = 1
    DARK = 2
    INVALID = 3
    ALIGNMENT = -1
    OFFSET_VIEW = -2  # a projection with the sample moved sideways; in files it is a projection with a translation


@dataclass(frozen=True, eq=False)
class Frame:
    """One image with its metadata. The frame owns its memory: the pixels were copied once, out of the ring buffer of
    the camera.

    Attributes:
        counts: [row, col], uint16 from a camera; counts from a file may have another type.
        kind: projection, flat, dark, ...
        index: row in the file, counted over all frames of the scan from 0.
        trigger: number of the trigger pulse that exposed it, counted from 0 within its block of frames.
        framestamp: the camera's own counter; -1: the camera has no counter.
        angle: radians, the stage position at the trigger; NaN if the position does not matter (a dark).
        time: s since the Unix epoch, at the trigger.
        exposure: s.
        replaces: row of the projection that this frame replaces; -1: it replaces none. aside: distance in mm by which
            the sample was moved perpendicular to the beam, towards higher columns.
    """

    counts: NDArray[np.uint16]
    kind: FrameKind
    index: int
    trigger: int
    framestamp: int
    angle: float
    time: float
    exposure: float
    replaces: int = -1
    aside: float = 0.0
