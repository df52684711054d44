"""Dark: are the darks dark, and do they stay the same?"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from beamline.monitor.digest import FrameDigest
from beamline.monitor.flag import Flag, Level, ScanContext
from beamline.monitor.preview import thinned
from drivers.frame import Frame, FrameKind

NAME = "dark"
TRIM = 10  # one preview block in so many is left out at either end: zingers, which say nothing about the camera


@dataclass(frozen=True)
class Limits:
    """`drift`: counts by which a dark may differ from the first one; `light`: fraction of the flats' mean."""

    drift: float = 5.0
    light: float = 0.5


@dataclass(frozen=True, eq=False)
class State:
    """Preview blocks and mean counts of the first dark and mean of the first flat, None before any."""

    limits: Limits = Limits()
    blocks: NDArray[np.float32] | None = None
    dark: float | None = None
    flat: float | None = None


def check(state: State, frame: Frame, digest: FrameDigest, context: ScanContext) -> tuple[State, Flag | None]:
    """Score: dark over flat where the shutter seems open, else counts of drift.

    The drift is a trimmed mean over the preview's blocks: one zinger moves the mean of a small frame by tens of counts.
    """
    if frame.kind is FrameKind.DARK:
        if state.flat is not None and digest.mean > state.limits.light * state.flat:
            return state, _open(state, frame.index, digest.mean / state.flat)
        blocks = digest.preview[thinned(digest.preview)]
        if state.blocks is None:
            return replace(state, blocks=blocks, dark=digest.mean), None
        drift = _trimmed_mean(blocks - state.blocks)
        if abs(drift) > state.limits.drift:
            advice = (
                f"The dark moved by {drift:+.1f} counts since the first dark: check the camera's cooling and for stray "
                "light."
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


def _trimmed_mean(values: NDArray[np.float32]) -> float:
    """Mean without the lowest and highest few (at least one each, where there are three)."""
    ordered = np.sort(values, axis=None)
    cut = min(max(1, ordered.size // TRIM), (ordered.size - 1) // 2)
    return float(ordered[cut : ordered.size - cut].mean())
