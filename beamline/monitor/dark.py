"""Dark: are the darks dark, and do they stay the same?"""

from __future__ import annotations

from dataclasses import dataclass, replace

from beamline.digest import FrameDigest
from beamline.monitor.flag import Context, Flag, Level
from drivers.frame import Frame, FrameKind

NAME = "dark"


@dataclass(frozen=True)
class Limits:
    """`drift`: counts by which a dark's mean may differ from the first one's; `light`: fraction of the flats' mean."""

    drift: float = 5.0
    light: float = 0.5


@dataclass(frozen=True)
class State:
    """Mean counts of the first dark and of the first flat, None before any."""

    limits: Limits = Limits()
    dark: float | None = None
    flat: float | None = None


def check(state: State, frame: Frame, digest: FrameDigest, context: Context) -> tuple[State, Flag | None]:
    """Score: dark over flat where the shutter seems open, else counts of drift."""
    if frame.kind is FrameKind.DARK:
        if state.flat is not None and digest.mean > state.limits.light * state.flat:
            return state, _open(state, frame.index, digest.mean / state.flat)
        if state.dark is None:
            return replace(state, dark=digest.mean), None
        drift = digest.mean - state.dark
        if abs(drift) > state.limits.drift:
            advice = (
                f"The dark's mean moved by {drift:+.1f} counts since the first dark: check the camera's cooling and "
                "for stray light."
            )
            return state, Flag(NAME, Level.WARN, frame.index, drift, state.limits.drift, advice)
    elif frame.kind is FrameKind.FLAT and state.flat is None:
        state = replace(state, flat=digest.mean)
        if state.dark is not None and state.dark > state.limits.light * digest.mean:
            return state, _open(state, frame.index, state.dark / digest.mean)
    return state, None


def _open(state: State, view: int, ratio: float) -> Flag:
    advice = (
        f"The darks have {ratio:.0%} of the flats' counts: the shutter was open for the darks or closed for the flats. "
        "Check the shutter and the beam, then start again."
    )
    return Flag(NAME, Level.ALARM, view, ratio, state.limits.light, advice)
