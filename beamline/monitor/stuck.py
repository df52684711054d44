"""Stuck: the same image twice. Noise never repeats, so an equal checksum is a frame that was delivered again."""

from __future__ import annotations

from dataclasses import dataclass, replace

from beamline.monitor.digest import FrameDigest
from beamline.monitor.flag import Flag, Level, ScanContext
from drivers.frame import Frame

NAME = "stuck"


@dataclass(frozen=True)
class Limits:
    """Nothing to set: one repetition is one too many."""


@dataclass(frozen=True)
class State:
    """`checksum` of the frame before; `repeats`: how many frames in a row have had it."""

    limits: Limits = Limits()
    checksum: int | None = None
    repeats: int = 0


def check(state: State, frame: Frame, digest: FrameDigest, context: ScanContext) -> tuple[State, Flag | None]:
    """Score: repetitions in a row. Frames of one single grey (a simulated dark without noise) say nothing."""
    if digest.checksum != state.checksum or digest.variance == 0:
        return replace(state, checksum=digest.checksum, repeats=0), None
    state = replace(state, repeats=state.repeats + 1)
    advice = (
        f"Pixel for pixel the frame before, {state.repeats} time{'s' if state.repeats > 1 else ''} in a row: "
        "the camera or its driver repeats a buffer. Stop and restart the camera."
    )
    return state, Flag(NAME, Level.ALARM, frame.index, state.repeats, 0, advice)
