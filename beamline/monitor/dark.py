"""Dark: light in the darks, and their drift."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np
import pydantic
from numpy.typing import NDArray

from beamline.monitor.check import Flag, Level, Look, Policy, ScanContext
from beamline.monitor.digest import FrameDigest, thinned
from beamline.monitor.references import FEW, READOUT
from drivers.base.frame import Frame, FrameKind

TRIM = 10  # one preview block in so many is left out at either end: zingers, which say nothing about the camera
SHUT = 3.0  # flats outshine a dark by so many noises of its pixels, or the shutter was open


@dataclass(frozen=True, eq=False)
class DarkState:
    """Preview blocks and mean counts of the first dark and mean of the first flat, None before any; `noise`: counts, of
    a pixel of that dark."""

    blocks: NDArray[np.float32] | None = None
    dark: float | None = None
    flat: float | None = None
    noise: float = 0.0


@dataclass(frozen=True)
class DarkCheck:
    """Score: dark over flat if the shutter seems open, otherwise counts of drift.

    The drift is a trimmed mean over the preview's blocks: one zinger moves the mean of a small frame by tens of counts.
    """

    name: ClassVar[str] = "dark"
    bit: ClassVar[int] = 6
    unit: ClassVar[str] = "counts of drift, or fraction of the flats' counts"
    meaning: ClassVar[str] = "a dark differs from the first one, or darks are nearly as bright as flats"
    policy: ClassVar[Policy] = Policy.LOG

    drift: Annotated[
        float, pydantic.Field(ge=0, description="counts by which a dark may differ from the first one")
    ] = 5.0
    light: Annotated[
        float, pydantic.Field(ge=0, description="fraction of the flats' mean from which a dark has light")
    ] = 0.5

    start = DarkState

    def look(self, state: DarkState, frame: Frame, digest: FrameDigest, context: ScanContext) -> Look[DarkState]:
        if frame.kind is FrameKind.DARK:
            return self._look_at_dark(state, frame.index, digest)
        if frame.kind is FrameKind.FLAT and state.flat is None:
            state = replace(state, flat=digest.mean)
            if state.dark is not None and self._lit(state.dark, digest.mean, state.noise):
                return Look(state, self._shutter_open(frame.index, state.dark / digest.mean))
        return Look(state)

    def _look_at_dark(self, state: DarkState, view: int, digest: FrameDigest) -> Look[DarkState]:
        noise = math.sqrt(digest.variance)
        if state.flat is not None and self._lit(digest.mean, state.flat, noise):
            return Look(state, self._shutter_open(view, digest.mean / state.flat))
        blocks = thinned(digest.preview)
        if state.blocks is None:
            return Look(replace(state, blocks=blocks, dark=digest.mean, noise=noise))
        drift = _trimmed_mean(blocks - state.blocks)
        if abs(drift) <= self.drift:
            return Look(state)
        advice = (
            f"The dark moved by {drift:+.1f} counts since the first dark: check the camera's cooling and for stray "
            "light."
        )
        return Look(state, Flag(self.name, Level.WARN, view, drift, self.drift, advice))

    def _lit(self, dark: float, flat: float, noise: float) -> bool:
        """Whether the dark has light; an offset below flats that are bright only against readout noise is ignored."""
        few = noise < READOUT and SHUT * noise < flat - dark < FEW * noise
        return dark > self.light * flat and not few

    def _shutter_open(self, view: int, ratio: float) -> Flag:
        advice = (
            f"The darks have {ratio:.0%} of the flats' counts: the shutter was open for the darks or closed for the "
            "flats. Check the shutter and the beam, then start again."
        )
        return Flag(self.name, Level.ALARM, view, ratio, self.light, advice)


def _trimmed_mean(values: NDArray[np.float32]) -> float:
    """Mean without the lowest and highest few (at least one each, where there are three)."""
    ordered = np.sort(values, axis=None)
    cut = min(max(1, ordered.size // TRIM), (ordered.size - 1) // 2)
    return float(ordered[cut : ordered.size - cut].mean())
