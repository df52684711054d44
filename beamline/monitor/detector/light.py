"""Checks `gain` and `zingers`: sudden changes of beam intensity or camera gain, and bright spots in single frames."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from beamline.core.text import count
from beamline.monitor.change import FrameScatter, SampleChange
from beamline.monitor.check import CheckResult, Flag, Level, Logged, ScanContext
from beamline.monitor.digest import FrameDigest
from beamline.monitor.view import CellView, sums_of_places
from drivers.base.frame import Frame, FrameKind
from recon.base.setting import setting

SIGMAS = 8.0
PARTS = 5  # number of parts of the field of view, from left to right
ALIKE = 0.5  # allowed difference between the parts, as a fraction of the change; a moving shadow is only in some parts


@dataclass(frozen=True)
class GainCheck(Logged):
    """Score: uniform relative change of the intensity since the previous projection (beamline.monitor.change).

    Reason for the default: such a change is corrected only if flats are taken again. 1 % of the intensity changes the
    line integral of every ray by 0.01, a fifth of the absorption of 50 um of electrolyte. A top-up of the ring every
    few minutes changes the intensity by less. The noise of the score is 1e-4 for 128 x 512 pixels with 5000 photons.
    """

    name: ClassVar[str] = "gain"
    bit: ClassVar[int] = 8
    unit: ClassVar[str] = "relative change of the intensity"
    meaning: ClassVar[str] = "the beam intensity, or the gain of the camera, changed suddenly before this projection"

    warn: float = setting(0.01, "relative change of the intensity above which there is a warning", ge=0)
    alarm: float = setting(0.1, "relative change of the intensity above which there is an alarm", ge=0)

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
            f"Take new flats: the intensity changed by {score:+.1%} between two projections, uniformly over the frame. "
            "Likely causes are a top-up, a filter or slit that moved, or a change of the camera gain."
        )
        return CheckResult(after, Flag(self.name, level, frame.index, score, limit, advice))


def _everywhere(change: SampleChange, view: CellView | None) -> float:
    """The gain, if it is equal in all fifths of the field of view, from left to right. Otherwise 0, because the change
    is a moving shadow."""
    assert view is not None
    weighted = change.residual * view.weight, view.weight
    extra, intensity = (sums_of_places(part, 1, PARTS)[0] for part in weighted)
    brighter = math.log1p(change.gain)
    gains = brighter - extra[intensity > 0] / intensity[intensity > 0]
    alike = gains.size > 0 and np.ptp(gains) < ALIKE * abs(brighter)
    return change.gain if alike else 0.0


VIEWS = 20  # projections after which the number of zingers is reported
FEW = 10  # number of zingers in a projection that is never too large


@dataclass(frozen=True)
class ZingersState:
    """Number of projections so far, and number of their zingers."""

    views: int = 0
    zingers: int = 0


@dataclass(frozen=True)
class ZingersCheck(Logged):
    """Score: number of zingers of the frame, divided by its number of pixels. The number of zingers is reported once,
    as info.

    Reason for the default: at 1e-4, a slice with 2000 columns and 2000 projections has 400 rays with a zinger. Each
    zinger that is not removed makes a streak.
    """

    name: ClassVar[str] = "zingers"
    bit: ClassVar[int] = 32
    unit: ClassVar[str] = "zingers per pixel"
    meaning: ClassVar[str] = "many zingers: bright spots that are only in this frame"

    warn: float = setting(1e-4, "largest number of zingers per pixel that a projection may have", ge=0, le=1)

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
                f"Shield the detector against scattered and direct X-rays: this projection has {count(n, 'zinger')} "
                "(bright spots that are in no other frame). `beamline recon` replaces zingers of up to 3 x 3 pixels "
                "with their neighbours, but this number of zingers hides too much of the sample."
            )
            return CheckResult(state, Flag(self.name, Level.WARN, frame.index, score, self.warn, advice))
        if state.views != VIEWS or not state.zingers:
            return CheckResult(state)
        advice = (
            f"Nothing to do: {count(state.zingers, 'zinger')} in the first {VIEWS} projections. `beamline recon` "
            "replaces zingers of up to 3 x 3 pixels with their neighbours."
        )
        score = state.zingers / VIEWS / context.pixels
        return CheckResult(state, Flag(self.name, Level.INFO, frame.index, score, self.warn, advice))
