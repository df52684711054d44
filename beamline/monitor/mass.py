"""Mass: the total of a parallel projection is equal from every side, unless matter entered or left.

It is the moment of order 0 of the consistency conditions of Helgason (1965) and Ludwig (1966).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np
import pydantic

from beamline.monitor.check import Flag, Level, Look, Policy, ScanContext, at_edges
from beamline.monitor.digest import FrameDigest
from beamline.monitor.view import AIR, brightest_place
from drivers.base.frame import Frame
from recon.base.arrays import median_deviation

CALIBRATION = 10  # projections
SIGMAS = 6.0
EMPTY = 1e-3  # mean line integral of a field with nothing in it but noise


@dataclass(frozen=True)
class MassState:
    """`masses`: of the first projections; `usual`: their median, None before; `running`: outliers in a row."""

    masses: tuple[float, ...] = ()
    usual: float | None = None
    scatter: float = 0.0
    running: int = 0


@dataclass(frozen=True)
class MassCheck:
    """Score: relative change of the mean line integral. None without light, or if the sample exceeds the field."""

    name: ClassVar[str] = "mass"
    bit: ClassVar[int] = 5
    unit: ClassVar[str] = "relative change"
    meaning: ClassVar[str] = "the total absorption differs from that of the first projections, several views in a row"
    policy: ClassVar[Policy] = Policy.LOG

    warn: Annotated[float, pydantic.Field(ge=0, description="relative change of the total absorption")] = 0.03
    frames: Annotated[
        int, pydantic.Field(ge=1, description="projections in a row beyond the limit that make a finding")
    ] = 3

    start = MassState

    def look(self, state: MassState, frame: Frame, digest: FrameDigest, context: ScanContext) -> Look[MassState]:
        view, grid = context.view, context.grid
        if view is None or grid is None or not grid.flats:
            return Look(state)
        if max(at_edges(context)) > AIR:
            return Look(replace(state, running=0))
        lit = float(grid.lit.mean())
        if not lit:
            return Look(state)
        # A beam that weakens is no sample that enters; matter at an edge is no beam that weakens.
        mass = float(view.depth.mean()) / lit - brightest_place(view, grid)
        if state.usual is None:
            return Look(_calibrate(state, mass))
        if state.usual < EMPTY:
            return Look(state)
        score = mass / state.usual - 1
        limit = max(self.warn, SIGMAS * state.scatter)
        if abs(score) <= limit:
            return Look(replace(state, running=0))
        state = replace(state, running=state.running + 1)
        if state.running < self.frames:
            return Look(state)
        advice = (
            f"The sample's total absorption changed by {score:+.1%} for {state.running} views: something "
            f"{'entered' if score > 0 else 'left'} the field, or the sample changes. Look at the latest projection."
        )
        return Look(state, Flag(self.name, Level.WARN, frame.index, score, limit, advice))


def _calibrate(state: MassState, mass: float) -> MassState:
    masses = (*state.masses, mass)
    if len(masses) < CALIBRATION:
        return replace(state, masses=masses)
    usual = float(np.median(masses))
    scatter = median_deviation(np.array(masses) - usual) / usual if usual > 0 else 0.0
    return replace(state, masses=masses, usual=usual, scatter=scatter)
