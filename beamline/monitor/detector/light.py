"""Steps of the light, or of the camera's gain, between two views; and bright spots that only one view has."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from beamline.monitor.change import FrameScatter, SampleChange
from beamline.monitor.check import CheckResult, Flag, Level, Logged, ScanContext
from beamline.monitor.digest import FrameDigest
from beamline.monitor.view import CellView, sums_of_places
from drivers.base.frame import Frame, FrameKind
from recon.base.setting import setting

SIGMAS = 8.0
PARTS = 5  # of the field, from left to right
ALIKE = 0.5  # allowed difference between parts, as a share of the gain: a ghost is only in some of them


@dataclass(frozen=True)
class GainCheck(Logged):
    """Score: relative change of the light, equal in all places, since the view before (beamline.monitor.change).

    The default: flats divide a step out only if they are taken anew. 1 % of light is 0.01 of line integral in every
    ray, a fifth of what 50 um of electrolyte do. A ring that is topped up every few minutes steps by less. The figure's
    own noise is 1e-4 on 128 x 512 pixels of 5000 photons.
    """

    name: ClassVar[str] = "gain"
    bit: ClassVar[int] = 8
    unit: ClassVar[str] = "relative change of the light"
    meaning: ClassVar[str] = "the light, or the camera's gain, stepped between this view and the one before"

    warn: float = setting(0.01, "relative change of the light from one view to the next", ge=0)
    alarm: float = setting(0.1, "relative change that is an alarm", ge=0)

    start = FrameScatter

    def look(
        self, state: FrameScatter, frame: Frame, digest: FrameDigest, context: ScanContext
    ) -> CheckResult[FrameScatter]:
        if context.change is None:
            return CheckResult(state)
        score = _everywhere(context.change, context.view)
        after = state.with_figure(score)
        limit = max(self.warn, SIGMAS * state.sigma)
        if not state.ready or abs(score - state.mean) <= limit:
            return CheckResult(after)
        level, limit = (Level.ALARM, self.alarm) if abs(score) > self.alarm else (Level.WARN, limit)
        advice = (
            f"{score:+.1%} of light from one view to the next, equally everywhere: a top-up, a filter or slit that "
            "moved, or the camera's gain. Take new flats."
        )
        return CheckResult(after, Flag(self.name, level, frame.index, score, limit, advice))


def _everywhere(change: SampleChange, view: CellView | None) -> float:
    """The gain, if it is equal in all fifths of the field, from left to right; otherwise 0, because it is a ghost."""
    assert view is not None
    weighted = change.residual * view.weight, view.weight
    extra, light = (sums_of_places(part, 1, PARTS)[0] for part in weighted)
    brighter = math.log1p(change.gain)
    gains = brighter - extra[light > 0] / light[light > 0]
    alike = gains.size > 0 and np.ptp(gains) < ALIKE * abs(brighter)
    return change.gain if alike else 0.0


VIEWS = 20  # views after which their number is reported
FEW = 10  # zingers a view that are never too many


@dataclass(frozen=True)
class ZingersState:
    """Number of views so far, and of their zingers."""

    views: int = 0
    zingers: int = 0


@dataclass(frozen=True)
class ZingersCheck(Logged):
    """Score: zingers of the frame over its pixels. Their number is reported once, as a fact.

    The default: at 1e-4 a slice 2000 pixels wide of as many views has 400 rays with one, each a streak if it stays.
    """

    name: ClassVar[str] = "zingers"
    bit: ClassVar[int] = 32
    unit: ClassVar[str] = "zingers over pixels"
    meaning: ClassVar[str] = "many bright spots that are in this frame only"

    warn: float = setting(1e-4, "zingers over pixels that a view may have", ge=0, le=1)

    start = ZingersState

    def look(
        self, state: ZingersState, frame: Frame, digest: FrameDigest, context: ScanContext
    ) -> CheckResult[ZingersState]:
        if frame.kind is not FrameKind.PROJECTION:
            return CheckResult(state)
        n = context.spots.n
        state = replace(state, views=state.views + 1, zingers=state.zingers + n)
        score = n / context.pixels
        if score > self.warn and n > FEW:
            advice = (
                f"{n} bright spots that are in no other frame. `beamline recon` fills those of up to 3 x 3 pixels, "
                "but so many hide what is behind them: shield the detector against scattered and direct X-rays."
            )
            return CheckResult(state, Flag(self.name, Level.WARN, frame.index, score, self.warn, advice))
        if state.views != VIEWS or not state.zingers:
            return CheckResult(state)
        advice = (
            f"The first {VIEWS} views have {state.zingers} bright spots that are in one frame only. `beamline recon` "
            "fills those of up to 3 x 3 pixels from their neighbours."
        )
        score = state.zingers / VIEWS / context.pixels
        return CheckResult(state, Flag(self.name, Level.INFO, frame.index, score, self.warn, advice))
