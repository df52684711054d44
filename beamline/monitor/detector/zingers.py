"""Zingers: bright spots that only one view has."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import pydantic

from beamline.monitor.check import Flag, Level, Look, Policy, ScanContext
from beamline.monitor.digest import FrameDigest
from drivers.base.frame import Frame, FrameKind

VIEWS = 20  # views after which their number is reported
FEW = 10  # zingers a view that are never too many


@dataclass(frozen=True)
class ZingersState:
    """Views so far, and their zingers."""

    views: int = 0
    zingers: int = 0


@dataclass(frozen=True)
class ZingersCheck:
    """Score: zingers of the frame over its pixels. Their number is said once, as a fact.

    The default: at 1e-4 a slice 2000 pixels wide of as many views has 400 rays with one, each a streak if it stays.
    """

    name: ClassVar[str] = "zingers"
    bit: ClassVar[int] = 32
    unit: ClassVar[str] = "zingers over pixels"
    meaning: ClassVar[str] = "many bright spots that are in this frame only"
    policy: ClassVar[Policy] = Policy.LOG

    warn: Annotated[float, pydantic.Field(ge=0, le=1, description="zingers over pixels that a view may have")] = 1e-4

    start = ZingersState

    def look(self, state: ZingersState, frame: Frame, digest: FrameDigest, context: ScanContext) -> Look[ZingersState]:
        if frame.kind is not FrameKind.PROJECTION:
            return Look(state)
        n = context.spots.n
        state = replace(state, views=state.views + 1, zingers=state.zingers + n)
        score = n / context.pixels
        if score > self.warn and n > FEW:
            advice = (
                f"{n} bright spots that are in no other frame. `beamline recon` fills them, but so many hide what is "
                "behind them: shield the detector against scattered and direct X-rays."
            )
            return Look(state, Flag(self.name, Level.WARN, frame.index, score, self.warn, advice))
        if state.views != VIEWS or not state.zingers:
            return Look(state)
        advice = (
            f"The first {VIEWS} views have {state.zingers} bright spots that are in one frame only. `beamline recon` "
            "fills them from their neighbours."
        )
        score = state.zingers / VIEWS / context.pixels
        return Look(state, Flag(self.name, Level.INFO, frame.index, score, self.warn, advice))
