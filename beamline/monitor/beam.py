"""Beam: is as much light coming as when the flats were taken? Judged at the detector's edges, where there is air."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from beamline.monitor.digest import FrameDigest
from beamline.monitor.flag import Flag, Level, ScanContext
from beamline.monitor.preview import edge_light, light, more_light
from drivers.frame import Frame, FrameKind

NAME = "beam"
CALIBRATION = 8  # projections
SIGMAS = 5.0
DARKNESS = 0.05  # of the flats: no sample lets so little through at both edges, the beam is off


@dataclass(frozen=True)
class Limits:
    """Fractions of the reference light by which it may change (warn, either way) or drop (alarm, lost)."""

    warn: float = 0.02
    alarm: float = 0.10
    lost: float = 0.50


@dataclass(frozen=True)
class State:
    """`levels`: light of the first projections; `baseline`: what they say is normal, None while calibrating.

    `reference`: light at the left and right edge that counts as full: the flats', or the first projection's.
    """

    limits: Limits = Limits()
    levels: tuple[float, ...] = ()
    reference: tuple[float, float] | None = None
    baseline: float | None = None
    scatter: float = 0.0


def check(state: State, frame: Frame, digest: FrameDigest, context: ScanContext) -> tuple[State, Flag | None]:
    """Score: fraction of the light that is gone (negative: too much)."""
    if frame.kind is FrameKind.FLAT and context.flat is not None:
        full = float(light(context.flat, context).mean()) * more_light(context, frame.exposure)
        score = 1 - float(light(digest.preview, context).mean()) / full if full > 0 else 0.0
        return state, _judge(state.limits, frame.index, score, state.limits.warn, "than in the flats before")
    if frame.kind is not FrameKind.PROJECTION:
        return state, None
    left, right = edge_light(digest.preview, context)
    if state.reference is None and context.flat is not None:
        scale = more_light(context, frame.exposure)
        full_left, full_right = edge_light(context.flat, context)
        state = replace(state, reference=(full_left * scale, full_right * scale))
    elif state.reference is None:
        state = replace(state, reference=(left, right))
    full_left, full_right = state.reference or (left, right)
    # The sample may cover one edge; the brighter one is the better witness of the beam.
    level = max(left / full_left if full_left > 0 else 0.0, right / full_right if full_right > 0 else 0.0)
    if state.baseline is None:
        return _calibrate(state, frame.index, level)
    warn = max(state.limits.warn, SIGMAS * state.scatter)
    return state, _judge(state.limits, frame.index, 1 - level / state.baseline, warn, "than in the flats")


def _calibrate(state: State, view: int, level: float) -> tuple[State, Flag | None]:
    """Learn what is normal. Edges well below the flats mean less beam, or no air there: say it once, then compare."""
    limits = state.limits
    if level < DARKNESS:
        return state, _judge(limits, view, 1 - level, limits.warn, "than in the flats")
    levels = (*state.levels, level)
    flag = None
    if level < 1 - limits.alarm and len(levels) == 1:
        advice = (
            f"The detector's edges get {level:.0%} of the flats' light: the sample covers both edges, or the beam is "
            "weaker than in the flats. From here on the light is compared with the first projections."
        )
        flag = Flag(NAME, Level.WARN, view, 1 - level, limits.alarm, advice)
    elif level >= 1 - limits.alarm:
        flag = _judge(limits, view, 1 - level, limits.warn, "than in the flats")
    state = replace(state, levels=levels)
    if len(levels) == CALIBRATION:
        middle = float(np.median(levels))
        baseline = 1.0 if middle >= 1 - limits.alarm else middle
        state = replace(state, baseline=baseline, scatter=float(np.std(levels)) / middle)
    return state, flag


def _judge(limits: Limits, view: int, score: float, warn: float, than: str) -> Flag | None:
    if abs(score) <= warn:
        return None
    if score > limits.lost:
        advice = f"The beam is lost: {score:.0%} less light {than}. Check ring current, front end and shutter."
        return Flag(NAME, Level.ALARM, view, score, limits.lost, advice)
    if score > limits.alarm:
        advice = f"{score:.0%} less light {than}. Check ring current, slits and filters; take new flats."
        return Flag(NAME, Level.ALARM, view, score, limits.alarm, advice)
    advice = f"{abs(score):.1%} {'less' if score > 0 else 'more'} light {than}. Take flats more often."
    return Flag(NAME, Level.WARN, view, score, warn, advice)
