"""Mass: the total of a parallel projection is the same from every side, unless something came or went.

It is the moment of order 0 of the consistency conditions of Helgason (1965) and Ludwig (1966).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from beamline.monitor.digest import FrameDigest
from beamline.monitor.flag import Flag, Level, ScanContext
from beamline.monitor.preview import edges, thinned, transmission
from drivers.frame import Frame, FrameKind

NAME = "mass"
CALIBRATION = 10  # projections
SIGMAS = 6.0
AIR = 0.05  # line integral at the edges up to which the whole sample is in the field
DARKEST = 1e-3  # transmission below which the logarithm would only show noise
EMPTY = 1e-3  # mean line integral of a field with nothing in it but noise


@dataclass(frozen=True)
class Limits:
    """`warn`: relative change of the total; `frames`: how many in a row make a finding."""

    warn: float = 0.03
    frames: float = 3


@dataclass(frozen=True)
class State:
    """`masses`: of the first projections; `usual`: their median, None before; `running`: outliers in a row."""

    limits: Limits = Limits()
    masses: tuple[float, ...] = ()
    usual: float | None = None
    scatter: float = 0.0
    running: int = 0


def check(state: State, frame: Frame, digest: FrameDigest, context: ScanContext) -> tuple[State, Flag | None]:
    """Score: relative change of the mean line integral. Silent where the sample is cut off by the detector's edge."""
    if frame.kind is not FrameKind.PROJECTION:
        return state, None
    through = transmission(digest.preview, context, frame.exposure, thinned(digest.preview))
    if through is None:
        return state, None
    integrals = -np.log(np.clip(np.nan_to_num(through, nan=1.0), DARKEST, None))
    left, right = edges(integrals)
    if max(left, right) > AIR:
        return replace(state, running=0), None
    mass = float(integrals.mean()) - (left + right) / 2  # the beam's changes are not the sample's
    if state.usual is None:
        return _calibrate(state, mass), None
    if state.usual < EMPTY:
        return state, None
    score = mass / state.usual - 1
    limit = max(state.limits.warn, SIGMAS * state.scatter)
    if abs(score) <= limit:
        return replace(state, running=0), None
    state = replace(state, running=state.running + 1)
    if state.running < state.limits.frames:
        return state, None
    advice = (
        f"The sample's total absorption changed by {score:+.1%} for {state.running} views: something "
        f"{'entered' if score > 0 else 'left'} the field, or the sample changes. Look at the latest projection."
    )
    return state, Flag(NAME, Level.WARN, frame.index, score, limit, advice)


def _calibrate(state: State, mass: float) -> State:
    masses = (*state.masses, mass)
    if len(masses) < CALIBRATION:
        return replace(state, masses=masses)
    usual = float(np.median(masses))
    deviation = float(np.median(np.abs(np.array(masses) - usual)))
    scatter = 1.4826 * deviation / usual if usual > 0 else 0.0  # MAD of a normal distribution to its sigma
    return replace(state, masses=masses, usual=usual, scatter=scatter)
