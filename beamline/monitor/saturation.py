"""Saturation: pixels at the end of their range, whose true count nobody will ever know."""

from __future__ import annotations

from dataclasses import dataclass, replace

from beamline.monitor.digest import FrameDigest
from beamline.monitor.flag import Flag, Level, ScanContext
from drivers.frame import Frame, FrameKind

NAME = "saturation"
FEW_PIXELS = 2  # a cosmic ray saturates a pixel or two; that is no exposure too long


@dataclass(frozen=True)
class Limits:
    """Fractions of the pixels."""

    warn: float = 1e-5
    alarm: float = 1e-3


@dataclass(frozen=True)
class State:
    """`hot`: the fraction that is saturated even without light."""

    limits: Limits = Limits()
    hot: float = 0.0


def check(state: State, frame: Frame, digest: FrameDigest, context: ScanContext) -> tuple[State, Flag | None]:
    """Score: fraction of saturated pixels beyond those that are saturated in the darks."""
    if frame.kind is FrameKind.DARK:
        return replace(state, hot=max(state.hot, digest.saturated_fraction)), None
    score = digest.saturated_fraction - state.hot
    limits = state.limits
    if score <= max(limits.warn, FEW_PIXELS / context.pixels):
        return state, None
    level, limit = (Level.ALARM, limits.alarm) if score > limits.alarm else (Level.WARN, limits.warn)
    advice = (
        f"{score:.2%} of the pixels are saturated (>= {context.saturation:g}). Shorten the exposure or add a filter."
    )
    return state, Flag(NAME, level, frame.index, score, limit, advice)
