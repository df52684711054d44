"""Pixels: the camera's pixels without light beside lit ones, and pixels without a number."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np
import pydantic
import scipy
from numpy.typing import NDArray

from beamline.monitor.check import Flag, Level, Look, Policy, ScanContext, light
from beamline.monitor.digest import LARGEST, FrameDigest
from beamline.monitor.view import BRIGHT, UNLIT
from drivers.base.frame import Frame, FrameKind
from recon.base.jit import njit

DEAD = 0.2  # share of the light of the darkest preview block around it
NAMED = 5  # most pixels that are named
HOLES = 1e-4  # share of the pixels that may hold no number; a column of 4096 is more
HALF = 0.5  # share of the pixels: with more missing, a view is lost

PixelPlaces = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class PixelsState:
    """`dead`: places row * columns + column that were dark in all flats of the latest group, None before any.

    `holes`: largest fraction of pixels without a number in a dark or flat: a mask of the detector.
    """

    dead: PixelPlaces | None = None
    in_flats: bool = False
    reported: bool = False
    holes: float = 0.0


@dataclass(frozen=True)
class PixelsCheck:
    """Score: fraction of the pixels that are dead: in all flats of the scan's first group they have less than a fifth
    of the light around them. It is reported at the first view, as a fact where they are few. In a view also the
    fraction that holds no number (NaN, infinite, beyond LARGEST) but does in the darks and flats; in any frame where
    none does.

    The default: a thousandth of the pixels are one in every column of a detector of 1000 rows, each a ring in a slice.
    """

    name: ClassVar[str] = "pixels"
    bit: ClassVar[int] = 12
    unit: ClassVar[str] = "fraction of the pixels"
    meaning: ClassVar[str] = "many pixels of the camera are dead, or hold no number"
    policy: ClassVar[Policy] = Policy.LOG

    warn: Annotated[float, pydantic.Field(ge=0, le=1, description="fraction of the pixels that may be dead")] = 1e-3

    start = PixelsState

    def look(self, state: PixelsState, frame: Frame, digest: FrameDigest, context: ScanContext) -> Look[PixelsState]:
        holes = digest.invalid_fraction
        if holes == 1:  # no mask, whatever the frame shows
            return Look(state, self._without_number(frame.index, holes))
        if frame.kind is not FrameKind.PROJECTION:
            state = replace(state, holes=max(state.holes, holes))
        elif holes - state.holes > HOLES:
            return Look(state, self._without_number(frame.index, holes - state.holes))
        if state.reported:
            return Look(state)
        if frame.kind is FrameKind.FLAT:
            dead = _dead(frame, digest, context)
            if state.in_flats and state.dead is not None:
                dead = np.intersect1d(state.dead, dead, assume_unique=True)
            return Look(replace(state, dead=dead, in_flats=True))
        state = replace(state, in_flats=False)
        if frame.kind is not FrameKind.PROJECTION or state.dead is None:
            return Look(state)
        return Look(replace(state, reported=True), self._flag(frame, state.dead) if state.dead.size else None)

    def _without_number(self, row: int, score: float) -> Flag:
        advice = (
            f"{score:.2%} of the pixels hold no number (NaN, infinite or beyond {LARGEST:g}), more than in darks and "
            "flats: the camera's link, or the program that wrote them. `beamline recon` fills pixels, and leaves out a "
            "view without any."
        )
        return Flag(self.name, Level.ALARM if score > HALF else Level.WARN, row, score, HOLES, advice)

    def _flag(self, frame: Frame, dead: PixelPlaces) -> Flag:
        rows, cols = np.unravel_index(dead, frame.counts.shape)
        score = dead.size / frame.counts.size
        level = Level.WARN if score > self.warn else Level.INFO
        named = ", ".join(f"({row}, {col})" for row, col in zip(rows[:NAMED], cols[:NAMED], strict=True))
        advice = (
            f"Pixels without light in the flats where their neighbours have some: {dead.size}, at (row, column) {named}"
            f"{' ...' if dead.size > NAMED else ''}. Each is a ring in its slice; `beamline recon` fills them from "
            "their neighbours."
        )
        region = int(rows.min()), int(rows.max()) + 1, int(cols.min()), int(cols.max()) + 1
        return Flag(self.name, level, frame.index, score, self.warn, advice, region)


def _dead(frame: Frame, digest: FrameDigest, context: ScanContext) -> PixelPlaces:
    """Places of the pixels of a flat that are dark within a lit block."""
    above = light(digest.preview, context)
    block = math.ceil(frame.counts.shape[1] / above.shape[1])
    dark = digest.preview - above
    around = scipy.ndimage.minimum_filter(above, 3)  # a dark pixel at the edge of a shadow is not dead
    limit = np.where(around > UNLIT * np.percentile(above[::2, ::2], BRIGHT), dark + DEAD * around, -np.inf)
    places = np.empty(frame.counts.size // 2, np.int64)
    return places[: _darker(frame.counts, limit.astype(np.float32), block, places)].copy()


@njit(nogil=True, cache=True)
def _darker(counts, limit, block, places):
    """Fills `places` with the pixels below the limit of their block, until it is full: their number."""
    n = 0
    for row in range(counts.shape[0]):
        line = limit[min(row // block, limit.shape[0] - 1)]
        for col in range(counts.shape[1]):
            if counts[row, col] < line[min(col // block, line.size - 1)]:
                if n == places.size:
                    return n
                places[n] = row * counts.shape[1] + col
                n += 1
    return n
