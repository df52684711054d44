"""Beam: drift of the light against the flats, and its dips and flashes.

The drift against the flats is judged in air: the brightest place of a view. It is reported once, and again only after
it has gone. A dip is judged by the change from view to view (beamline.monitor.change), which needs no
air. These changes have errors of one sign where dense particles turn fast; these would sum up to a dip. A change counts
only where the light of the whole view moved with it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from beamline.monitor.change import SampleChange
from beamline.monitor.check import Flag, Level, Look, Policy, ScanContext, light, more_light
from beamline.monitor.digest import FrameDigest
from beamline.monitor.scatter import FrameScatter
from beamline.monitor.view import CellGrid, CellValues, CellView
from drivers.base.frame import Frame, FrameKind

PLACES = (4, 16)  # parts of the field, down and across; the brightest one is air
COVERED = 0.1  # loss of light at the brightest place: with more there is no air, or the beam fell earlier
LASTS = 5  # views that a drift must last
GONE = 0.5  # share of the limit below which a drift has gone
PATIENCE = 20  # views after which a dip is the new normal
MEMORY = 0.05  # weight of the newest view in the usual light
CONFIRMED = 0.5  # share of a change that the whole view's light must show: the rest may be the sample's turning
SIGMAS = 6.0  # standard deviations of the changes that a dip must have


@dataclass(frozen=True)
class BeamState:
    drifting: int = 0  # views in a row beyond the limit; after `said`, views in a row within it
    said: bool = False  # the drift was flagged
    covered: bool = False  # the missing air was reported
    level: float = 0.0  # logarithm of the light over that of the first view, from its confirmed changes
    usual: float = 0.0  # the normal level
    dipping: int = 0  # views in a row with a dip
    whole: float = math.nan  # logarithm of the light of the whole view before; NaN before any
    # changes: of the light from view to view, none larger than half of `alarm`. So one dip is no scatter, and the limit
    # is at most 3.8 times `alarm`
    changes: FrameScatter = field(default_factory=FrameScatter)


@dataclass(frozen=True)
class BeamCheck:
    """Score: lost fraction of the light (negative: gained).

    The defaults: 2 % of light are 0.02 of line integral in every ray if nobody corrects it, as air beside the sample
    allows. 10 % at once are no drift of a ring.
    """

    name: ClassVar[str] = "beam"
    bit: ClassVar[int] = 0
    unit: ClassVar[str] = "fraction of the reference light"
    meaning: ClassVar[str] = "the light differs from that of the flats, or dipped against the views before"
    policy: ClassVar[Policy] = Policy.LOG

    drift: Annotated[float, Field(ge=0, description="fraction by which the light may drift, either way")] = 0.02
    dip: Annotated[float, Field(ge=0, lt=1, description="fraction of the light whose loss at once is an alarm")] = 0.10

    start = BeamState

    def look(self, state: BeamState, frame: Frame, digest: FrameDigest, context: ScanContext) -> Look[BeamState]:
        if frame.kind is FrameKind.FLAT and context.flat is not None:
            full = float(light(context.flat, context).mean()) * more_light(context, frame.exposure)
            score = 1 - float(light(digest.preview, context).mean()) / full if full > 0 else 0.0
            return Look(state, self._flat(frame.index, score))
        if context.view is None or context.grid is None:
            return Look(state)
        state, flag = self._dip(state, frame.index, context.change, _whole(context.view, context.grid))
        if flag is not None or not context.grid.flats or state.dipping:
            return Look(state, flag)
        return self._drift(state, frame.index, context.view, context.grid)

    def _flat(self, row: int, score: float) -> Flag | None:
        if abs(score) <= self.drift:
            return None
        level, limit = (Level.ALARM, self.dip) if abs(score) > self.dip else (Level.WARN, self.drift)
        advice = f"{_size(score)} light than in the flats before. Take flats more often."
        return Flag(self.name, level, row, score, limit, advice)

    def _dip(
        self, state: BeamState, row: int, change: SampleChange | None, whole: float
    ) -> tuple[BeamState, Flag | None]:
        """A dip or a flash of more than `dip` is flagged in every view, until it is over or has become normal."""
        moved, state = whole - state.whole, replace(state, whole=whole)
        if change is None:
            return state, None
        brighter = math.log1p(change.gain)
        level = state.level + (brighter if brighter * moved > CONFIRMED * brighter**2 else 0.0)
        score = -math.expm1(level - state.usual)
        limit = max(self.dip, SIGMAS * state.changes.sigma)
        most = self.dip / 2
        state = replace(state, level=level, changes=state.changes.with_figure(min(max(brighter, -most), most)))
        if abs(score) <= limit or state.dipping >= PATIENCE:
            usual = level if state.dipping >= PATIENCE else state.usual + MEMORY * (level - state.usual)
            return replace(state, usual=usual, dipping=0), None
        advice = (
            f"{_size(score)} light than in the views before. Check ring current, slits and filters; take new flats."
        )
        return replace(state, dipping=state.dipping + 1), Flag(self.name, Level.ALARM, row, score, limit, advice)

    def _drift(self, state: BeamState, row: int, view: CellView, grid: CellGrid) -> Look[BeamState]:
        score = -math.expm1(-_air(view, grid))
        if score > COVERED:
            if state.covered:
                return Look(replace(state, drifting=0))
            advice = (
                f"No part of the frame gets more than {1 - score:.0%} of the flats' light. The sample covers all of "
                "it, or the beam is weaker than in the flats. Its drift against the flats cannot be told."
            )
            return Look(replace(state, covered=True), Flag(self.name, Level.INFO, row, score, COVERED, advice))
        away = abs(score) > (GONE * self.drift if state.said else self.drift)
        drifting = 0 if away is state.said else state.drifting + 1
        if drifting < LASTS:
            return Look(replace(state, drifting=drifting))
        state = replace(state, drifting=0, said=not state.said)
        if not state.said:
            return Look(state)
        advice = f"{_size(score)} light than in the flats, where there is air. Take flats more often."
        return Look(state, Flag(self.name, Level.WARN, row, score, self.drift, advice))


def _size(score: float) -> str:
    return f"{abs(score):.1%} {'less' if score > 0 else 'more'}"


def _whole(view: CellView, grid: CellGrid) -> float:
    """Logarithm of the mean transmission of the lit cells; NaN where none is."""
    lit = grid.lit > 0
    return math.log(float(np.exp(-view.depth[lit]).mean())) if lit.any() else math.nan


def _air(view: CellView, grid: CellGrid) -> float:
    """Mean line integral of the brightest place of the lit field: 0 in air."""
    depth, lit = view.depth[:, grid.left : grid.right + 1], grid.lit[:, grid.left : grid.right + 1]
    down, across = (min(parts, n) for parts, n in zip(PLACES, depth.shape, strict=True))
    sums, cells = (_places(part, down, across) for part in (depth, lit))
    means = sums[cells > 0] / cells[cells > 0]
    return float(means.min()) if means.size else 0.0


def _places(image: CellValues, down: int, across: int) -> CellValues:
    """Sums over a grid of places."""
    rows, cols = (np.arange(parts) * n // parts for parts, n in zip((down, across), image.shape, strict=True))
    return np.add.reduceat(np.add.reduceat(image, rows, axis=0), cols, axis=1)
