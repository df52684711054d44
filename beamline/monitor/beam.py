"""Beam: is as much light coming as when the flats were taken? Judged at the detector's edges, where there is air."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from beamline.monitor.check import Flag, Level, Look, Policy, ScanContext
from beamline.monitor.digest import FrameDigest
from beamline.monitor.preview import edge_light, light, more_light
from drivers.frame import Frame, FrameKind

CALIBRATION = 8  # projections
SIGMAS = 5.0
DARKNESS = 0.05  # of the flats: no sample lets so little through at both edges, the beam is off


@dataclass(frozen=True)
class BeamState:
    """What the first projections say.

    Attributes:
        levels: light of the first projections, over `reference`.
        reference: light at the left and right edge that counts as full: the flats', or the first projection's.
        baseline: the level that is normal, None while calibrating.
        scatter: relative standard deviation of `levels`.
    """

    levels: tuple[float, ...] = ()
    reference: tuple[float, float] | None = None
    baseline: float | None = None
    scatter: float = 0.0


@dataclass(frozen=True)
class Beam:
    """Score: fraction of the light that is gone (negative: there is more)."""

    name: ClassVar[str] = "beam"
    bit: ClassVar[int] = 0
    unit: ClassVar[str] = "fraction of the reference light"
    meaning: ClassVar[str] = "the light differs from that of the flats, or of the first projections"
    policy: ClassVar[Policy] = Policy.LOG

    warn: Annotated[float, Field(ge=0, description="fraction by which the light may change, either way")] = 0.02
    alarm: Annotated[float, Field(ge=0, description="fraction of the light whose loss is an alarm")] = 0.10
    lost: Annotated[float, Field(ge=0, description="fraction of the light without which the beam is lost")] = 0.50

    def start(self) -> BeamState:
        return BeamState()

    def look(self, state: BeamState, frame: Frame, digest: FrameDigest, context: ScanContext) -> Look[BeamState]:
        if frame.kind is FrameKind.FLAT and context.flat is not None:
            full = float(light(context.flat, context).mean()) * more_light(context, frame.exposure)
            score = 1 - float(light(digest.preview, context).mean()) / full if full > 0 else 0.0
            return Look(state, self._judge(frame.index, score, self.warn, "than in the flats before"))
        if frame.kind is not FrameKind.PROJECTION:
            return Look(state)
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
            return self._calibrate(state, frame.index, level)
        warn = max(self.warn, SIGMAS * state.scatter)
        return Look(state, self._judge(frame.index, 1 - level / state.baseline, warn, "than in the flats"))

    def _calibrate(self, state: BeamState, view: int, level: float) -> Look[BeamState]:
        """Learn what is normal. Edges well below the flats mean less beam, or no air there: flagged once, then the
        light is compared with that level."""
        if level < DARKNESS:
            return Look(state, self._judge(view, 1 - level, self.warn, "than in the flats"))
        levels = (*state.levels, level)
        flag = None
        if level < 1 - self.alarm and len(levels) == 1:
            advice = (
                f"The detector's edges get {level:.0%} of the flats' light: the sample covers both edges, or the beam "
                "is weaker than in the flats. From here on the light is compared with the first projections."
            )
            flag = Flag(self.name, Level.WARN, view, 1 - level, self.alarm, advice)
        elif level >= 1 - self.alarm:
            flag = self._judge(view, 1 - level, self.warn, "than in the flats")
        state = replace(state, levels=levels)
        if len(levels) == CALIBRATION:
            middle = float(np.median(levels))
            baseline = 1.0 if middle >= 1 - self.alarm else middle
            state = replace(state, baseline=baseline, scatter=float(np.std(levels)) / middle)
        return Look(state, flag)

    def _judge(self, view: int, score: float, warn: float, than: str) -> Flag | None:
        if abs(score) <= warn:
            return None
        if score > self.lost:
            advice = f"The beam is lost: {score:.0%} less light {than}. Check ring current, front end and shutter."
            return Flag(self.name, Level.ALARM, view, score, self.lost, advice)
        if score > self.alarm:
            advice = f"{score:.0%} less light {than}. Check ring current, slits and filters; take new flats."
            return Flag(self.name, Level.ALARM, view, score, self.alarm, advice)
        advice = f"{abs(score):.1%} {'less' if score > 0 else 'more'} light {than}. Take flats more often."
        return Flag(self.name, Level.WARN, view, score, warn, advice)
