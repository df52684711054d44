"""Saturation: pixels at the end of their range, whose true count is unknown; zingers have a check of their own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import pydantic

from beamline.monitor.check import Flag, Level, Look, Policy, ScanContext
from beamline.monitor.digest import FrameDigest
from drivers.base.frame import Frame, FrameKind

FEW_PIXELS = 2  # fewer may be hot pixels that the darks did not show


@dataclass(frozen=True)
class SaturationState:
    """`hot`: the fraction of the pixels that is saturated even without light."""

    hot: float = 0.0


@dataclass(frozen=True)
class SaturationCheck:
    """Score: fraction of saturated pixels beyond those that are saturated in the darks."""

    name: ClassVar[str] = "saturation"
    bit: ClassVar[int] = 1
    unit: ClassVar[str] = "fraction of the pixels"
    meaning: ClassVar[str] = "more pixels are saturated than in the darks"
    policy: ClassVar[Policy] = Policy.LOG

    warn: Annotated[float, pydantic.Field(ge=0, description="fraction of saturated pixels above which it warns")] = 1e-5
    alarm: Annotated[
        float, pydantic.Field(ge=0, description="fraction of saturated pixels above which it is an alarm")
    ] = 1e-3

    start = SaturationState

    def look(
        self, state: SaturationState, frame: Frame, digest: FrameDigest, context: ScanContext
    ) -> Look[SaturationState]:
        if frame.kind is FrameKind.DARK:
            return Look(SaturationState(max(state.hot, digest.saturated_fraction)))
        score = digest.saturated_fraction - state.hot - context.spots.saturated / context.pixels
        if score <= max(self.warn, FEW_PIXELS / context.pixels):
            return Look(state)
        level, limit = (Level.ALARM, self.alarm) if score > self.alarm else (Level.WARN, self.warn)
        advice = (
            f"{score:.2%} of the pixels are saturated (>= {context.saturation:g}). Shorten the exposure or add a "
            "filter."
        )
        return Look(state, Flag(self.name, level, frame.index, score, limit, advice))
