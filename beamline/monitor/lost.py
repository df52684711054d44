"""Lost: a beam without light. Only this check's alarms end a scan by default."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import pydantic

from beamline.monitor.check import AGAIN, Flag, Level, Look, Policy, ScanContext
from beamline.monitor.digest import FrameDigest
from drivers.base.frame import Frame, FrameKind


@dataclass(frozen=True)
class LostState:
    """Empty state: the monitor itself keeps the last good view."""


@dataclass(frozen=True)
class LostCheck:
    """Score: lost share of the light on nine tenths of the frame, against the last view with light.

    The default: neither drift nor the decay of a ring's current between two top-ups takes half of the light. A sample
    that turns takes no light from all places at once.
    """

    name: ClassVar[str] = "lost"
    bit: ClassVar[int] = 7
    unit: ClassVar[str] = "fraction of the light"
    meaning: ClassVar[str] = "the beam is gone"
    policy: ClassVar[Policy] = Policy.STOP

    alarm: Annotated[
        float, pydantic.Field(ge=0.5, le=1, description="fraction of the light without which it is lost")
    ] = 0.5

    start = LostState

    def look(self, state: LostState, frame: Frame, digest: FrameDigest, context: ScanContext) -> Look[LostState]:
        score = 1 - context.light_left
        if frame.kind is not FrameKind.PROJECTION or score <= self.alarm:
            return Look(state)
        empty = "Every pixel has one value: the frame was never written, or the camera gave none. Look at the file."
        advice = (
            f"The beam is lost: {score:.0%} of the light is gone. Check ring current, front end and shutter. {AGAIN}"
            if digest.variance
            else empty
        )
        return Look(state, Flag(self.name, Level.ALARM, frame.index, score, self.alarm, advice))
