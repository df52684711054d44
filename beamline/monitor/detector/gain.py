"""Gain: a step of the light, or of the camera's gain, between two views."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, ClassVar

import numpy as np
import pydantic

from beamline.monitor.change import SampleChange
from beamline.monitor.check import Flag, Level, Look, Policy, ScanContext
from beamline.monitor.digest import FrameDigest
from beamline.monitor.scatter import FrameScatter
from beamline.monitor.view import CellView
from drivers.base.frame import Frame

SIGMAS = 8.0
PARTS = 5  # of the field, from left to right
ALIKE = 0.5  # allowed difference between parts, as a share of the gain: a ghost is only in some of them


@dataclass(frozen=True)
class GainState:
    """Usual changes of the light between views."""

    usual: FrameScatter = field(default_factory=FrameScatter)


@dataclass(frozen=True)
class GainCheck:
    """Score: relative change of the light of all places alike since the view before (beamline.monitor.change).

    The default: flats divide a step out only if they are taken anew. 1 % of light is 0.01 of line integral in every
    ray, a fifth of what 50 um of electrolyte do. A ring that is topped up every few minutes steps by less. The figure's
    own noise is 1e-4 on 128 x 512 pixels of 5000 photons.
    """

    name: ClassVar[str] = "gain"
    bit: ClassVar[int] = 8
    unit: ClassVar[str] = "relative change of the light"
    meaning: ClassVar[str] = "the light, or the camera's gain, stepped between this view and the one before"
    policy: ClassVar[Policy] = Policy.LOG

    warn: Annotated[
        float, pydantic.Field(ge=0, description="relative change of the light from one view to the next")
    ] = 0.01
    alarm: Annotated[float, pydantic.Field(ge=0, description="relative change that is an alarm")] = 0.1

    start = GainState

    def look(self, state: GainState, frame: Frame, digest: FrameDigest, context: ScanContext) -> Look[GainState]:
        if context.change is None:
            return Look(state)
        score = _everywhere(context.change, context.view)
        after = GainState(state.usual.with_figure(score))
        limit = max(self.warn, SIGMAS * state.usual.sigma)
        if not state.usual.ready or abs(score - state.usual.mean) <= limit:
            return Look(after)
        level, limit = (Level.ALARM, self.alarm) if abs(score) > self.alarm else (Level.WARN, limit)
        advice = (
            f"{score:+.1%} of light from one view to the next, everywhere alike: a top-up, a filter or slit that "
            "moved, or the camera's gain. Take new flats."
        )
        return Look(after, Flag(self.name, level, frame.index, score, limit, advice))


def _everywhere(change: SampleChange, view: CellView | None) -> float:
    """The gain, if it is equal in all fifths of the field, from left to right; otherwise 0, because it is a ghost."""
    assert view is not None
    starts = np.arange(PARTS) * view.depth.shape[1] // PARTS
    extra, light = (np.add.reduceat(part.sum(axis=0), starts) for part in (change.residual * view.weight, view.weight))
    brighter = math.log1p(change.gain)
    gains = brighter - extra[light > 0] / light[light > 0]
    alike = gains.size > 0 and np.ptp(gains) < ALIKE * abs(brighter)
    return change.gain if alike else 0.0
