"""Timing: do the frames of a fly scan come as regularly as the triggers that were planned?"""

from __future__ import annotations

from dataclasses import dataclass, replace

from beamline.monitor.digest import FrameDigest
from beamline.monitor.flag import Flag, Level, ScanContext
from drivers.frame import Frame, FrameKind

NAME = "timing"


@dataclass(frozen=True)
class Limits:
    """Periods by which an interval may differ from a whole number of periods."""

    warn: float = 0.25


@dataclass(frozen=True)
class State:
    """Trigger and time of the projection before; -1 before the first."""

    limits: Limits = Limits()
    trigger: int = -1
    time: float = 0.0


def check(state: State, frame: Frame, digest: FrameDigest, context: ScanContext) -> tuple[State, Flag | None]:
    """Score: triggers that have no frame, or else periods by which the frame came too late (negative: too early)."""
    if frame.kind is not FrameKind.PROJECTION or context.period is None:
        return state, None
    before, state = state, replace(state, trigger=frame.trigger, time=frame.time)
    steps = frame.trigger - before.trigger
    if steps > 1:
        advice = f"{steps - 1} trigger{'s' if steps > 2 else ''} before this one exposed no frame, or it was lost."
        return state, Flag(NAME, Level.ALARM, frame.index, steps - 1, 0, advice)
    if before.trigger < 0 or frame.trigger in context.pass_starts:
        return state, None
    score = (frame.time - before.time) / context.period - steps
    if abs(score) <= state.limits.warn:
        return state, None
    advice = (
        f"The frame came {abs(score):.0%} of a period too {'late' if score > 0 else 'early'}: the stage does not turn "
        "evenly, or the trigger line picks up noise."
    )
    return state, Flag(NAME, Level.WARN, frame.index, score, state.limits.warn, advice)
