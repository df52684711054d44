"""Bands: rows that turn dark while the others do not, as after a readout fault or a lost packet."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from beamline.monitor.digest import FrameDigest
from beamline.monitor.flag import Flag, Level, ScanContext
from beamline.monitor.preview import light, thinned
from drivers.frame import Frame, FrameKind

NAME = "bands"
CALIBRATION = 5  # frames of a kind before a verdict
MEMORY = 0.2  # weight of the newest frame in the reference
SIGMAS = 8.0
PATIENCE = 20  # flagged frames in a row after which the change is the new normal: the sample, not the camera


@dataclass(frozen=True)
class Limits:
    """Fraction by which a preview row may lose light against its own past, relative to the other rows."""

    alarm: float = 0.15


@dataclass(frozen=True, eq=False)
class Profile:
    """Per preview row: the logarithm of its usual light, its usual change from frame to frame, and how often seen."""

    usual: NDArray[np.float64]
    change: NDArray[np.float64]
    seen: int = 1
    flagged: int = 0


@dataclass(frozen=True, eq=False)
class State:
    limits: Limits = Limits()
    projection: Profile | None = None
    flat: Profile | None = None


def check(state: State, frame: Frame, digest: FrameDigest, context: ScanContext) -> tuple[State, Flag | None]:
    """Score: the largest fraction of light that a preview row has lost. A row's light is its median over columns."""
    if frame.kind is FrameKind.PROJECTION:
        profile, flag = _look(state.projection, state.limits, frame.index, digest, context)
        return replace(state, projection=profile), flag
    if frame.kind is FrameKind.FLAT:
        profile, flag = _look(state.flat, state.limits, frame.index, digest, context)
        return replace(state, flat=profile), flag
    return state, None


def _look(
    profile: Profile | None, limits: Limits, view: int, digest: FrameDigest, context: ScanContext
) -> tuple[Profile, Flag | None]:
    blocks = light(digest.preview, context, thinned(digest.preview, rows=False))
    rows = np.log(np.maximum(np.median(blocks, axis=1), 0.5).astype(np.float64))
    if profile is None or profile.usual.shape != rows.shape:
        return Profile(rows, np.zeros_like(rows)), None
    deviation = rows - profile.usual
    deviation -= np.median(deviation)  # the beam dims all rows alike
    loss = 1 - np.exp(deviation)
    limit = np.maximum(limits.alarm, SIGMAS * profile.change)
    dark = np.flatnonzero(loss > limit)
    if profile.seen >= CALIBRATION and dark.size and profile.flagged < PATIENCE:
        worst = int(dark[np.argmax(loss[dark])])
        advice = (
            f"{dark.size} of {rows.size} preview rows (from {dark[0]}) lost up to {loss[worst]:.0%} of their light at "
            "once: a dark band. Check the camera's link and readout; repeat the view."
        )
        flag = Flag(NAME, Level.ALARM, view, float(loss[worst]), float(limit[worst]), advice)
        return replace(profile, flagged=profile.flagged + 1), flag
    weight = max(MEMORY, 1 / (profile.seen + 1))
    return Profile(
        usual=profile.usual + weight * (rows - profile.usual),
        change=profile.change + weight * (np.abs(deviation) - profile.change),
        seen=profile.seen + 1,
    ), None
