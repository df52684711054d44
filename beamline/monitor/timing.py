"""Timing: early and late frames of a fly scan, against the planned triggers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import pydantic

from beamline.monitor.check import Flag, Level, Look, Policy, ScanContext
from beamline.monitor.digest import FrameDigest
from drivers.base.frame import Frame, FrameKind


@dataclass(frozen=True)
class TimingState:
    """Trigger, framestamp and time of the projection before; -1 before the first."""

    trigger: int = -1
    framestamp: int = -1
    time: float = 0.0


@dataclass(frozen=True)
class TimingCheck:
    """Score: delay of the frame in periods (negative: early).

    Triggers without a frame before it are an INFO: the frame after the gap is as good as any.
    """

    name: ClassVar[str] = "timing"
    bit: ClassVar[int] = 4
    unit: ClassVar[str] = "trigger periods"
    meaning: ClassVar[str] = "the frame came early or late (fly scans)"
    policy: ClassVar[Policy] = Policy.LOG

    warn: Annotated[float, pydantic.Field(ge=0, description="periods by which a frame may come early or late")] = 0.25

    start = TimingState

    def look(self, state: TimingState, frame: Frame, digest: FrameDigest, context: ScanContext) -> Look[TimingState]:
        again = frame.replaces >= 0 or frame.trigger < state.trigger  # a repeated view has its old trigger
        if frame.kind is not FrameKind.PROJECTION or context.period is None or again:
            return Look(state)
        after = TimingState(frame.trigger, frame.framestamp, frame.time)
        steps = frame.trigger - state.trigger
        lost = steps - 1 - sum(state.trigger < view < frame.trigger for view in context.stored)
        if lost > 0:
            advice = f"{lost} trigger{'s' if lost > 1 else ''} before this one exposed no frame, or it was lost."
            return Look(after, Flag(self.name, Level.INFO, frame.index, lost, 0, advice))
        if state.trigger < 0 or 0 <= frame.framestamp <= state.framestamp:
            return Look(after)  # armed anew, for another pass or after a pause
        score = (frame.time - state.time) / context.period - steps
        if abs(score) <= self.warn:
            return Look(after)
        advice = (
            f"The frame came {abs(score):.0%} of a period too {'late' if score > 0 else 'early'}: the stage does not "
            "turn evenly, or the trigger line picks up noise."
        )
        return Look(after, Flag(self.name, Level.WARN, frame.index, score, self.warn, advice))
