"""Motion: jumps and slips of the sample, beyond steady rotation, and a sample that shakes."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar

import pydantic

from beamline.monitor.change import SPAN, SampleChange
from beamline.monitor.check import Flag, Level, Look, Policy, ScanContext
from beamline.monitor.digest import FrameDigest
from beamline.monitor.scatter import FrameScatter
from drivers.base.frame import Frame

SIGMAS = 8.0
CELLS = 0.02  # share of a cell: least limit of a shake
GONE, GROWN = 0.5, 2.0  # of its limit, below which a shake has gone; times what was told, above which it is told again
CONFIRMED = 0.5  # of a figure; if less of it differs from row to row, this part counts: a ghost is as high as the frame


@dataclass(frozen=True)
class MotionState:
    """Usual shifts across and down in pixels and turns in steps; `quiet`: views in which a jump echoes; `told`: pixels
    of the shake that was flagged last, 0: none, or it has gone."""

    across: FrameScatter = field(default_factory=FrameScatter)
    down: FrameScatter = field(default_factory=FrameScatter)
    turn: FrameScatter = field(default_factory=FrameScatter)
    quiet: int = 0
    told: float = 0.0


@dataclass(frozen=True)
class MotionCheck:
    """Score: displacement of the sample in pixels, beyond its rotation; steps of the stage if it is a slip.

    Only the view of the jump is flagged: later views are as good as earlier ones, but show another position.
    The defaults: half a pixel is what reconstructions from views at two positions begin to show (a doubled edge is as
    wide as the resolution). A flat face that comes into the beam's direction looks like a slip of up to two steps. A
    shake is a warning, once, and again when it has doubled: a quarter of a pixel takes a quarter of the contrast of the
    finest detail, of two pixels.
    """

    name: ClassVar[str] = "motion"
    bit: ClassVar[int] = 9
    unit: ClassVar[str] = "pixels, or steps of the stage"
    meaning: ClassVar[str] = "the sample jumped or slipped (alarm), or shakes (warn): views do not fit together"
    policy: ClassVar[Policy] = Policy.LOG

    alarm: Annotated[
        float, pydantic.Field(ge=0, description="pixels by which the sample may shift between two views")
    ] = 0.5
    steps: Annotated[float, pydantic.Field(ge=0, description="steps by which the stage may turn too far at once")] = 3.0
    shake: Annotated[
        float,
        pydantic.Field(
            ge=0, description="pixels, a standard deviation, by which views may stand beside the sample's way"
        ),
    ] = 0.25

    start = MotionState

    def look(self, state: MotionState, frame: Frame, digest: FrameDigest, context: ScanContext) -> Look[MotionState]:
        change = context.change
        if change is None:
            return Look(state)
        after = MotionState(
            state.across.with_figure(change.across),
            state.down.with_figure(change.down),
            state.turn.with_figure(change.turn),
            max(state.quiet - 1, 0),
            state.told,
        )
        if not state.across.ready or state.quiet:
            return Look(after)
        jump = self._jump(state, after, frame.index, change)
        return self._shake(after, frame.index, context) if jump is None else jump

    def _shake(self, state: MotionState, row: int, context: ScanContext) -> Look[MotionState]:
        assert context.grid is not None
        across, down = context.shake
        size, limit = math.hypot(across, down), max(self.shake, CELLS * context.grid.cell)
        if state.told and size < GONE * limit:
            return Look(replace(state, told=0.0))
        if size <= max(limit, GROWN * state.told):
            return Look(state)
        advice = (
            f"The sample shakes: at random, views stand {across:.2f} px across and {down:.2f} px down beside its way "
            "(standard deviations of the last hundred views or fewer). Look for vibration and for runout of the stage. "
            "The views are of use: `beamline recon --calibrate shifts` finds the place of each."
        )
        return Look(replace(state, told=size), Flag(self.name, Level.WARN, row, size, limit, advice))

    def _jump(self, state: MotionState, after: MotionState, row: int, change: SampleChange) -> Look[MotionState] | None:
        """A jump or a slip; None where there is none."""
        usual = state.across, state.down, state.turn
        change_of_place = change.across, change.down, change.turn
        limits = self.alarm, self.alarm, self.steps
        limit_across, limit_down, limit_turn = (
            max(least, SIGMAS * s.sigma) for least, s in zip(limits, usual, strict=True)
        )
        across, down, turn = (x - s.mean for x, s in zip(change_of_place, usual, strict=True))
        over = abs(across) > limit_across or abs(down) > limit_down or abs(turn) > limit_turn
        if over and (beside := change.beside_columns()) is not None:
            right, below, further = (x - s.mean for x, s in zip(beside, usual, strict=True))
            if math.hypot(right, below) < CONFIRMED * math.hypot(across, down):
                across, down = right, below
            if abs(further) < CONFIRMED * abs(turn):
                turn = further
        if abs(across) > limit_across or abs(down) > limit_down:
            score, limit = math.hypot(across, down), min(limit_across, limit_down)
            advice = (
                f"The sample jumped by {across:+.1f} px across and {down:+.1f} px down between two views: it slipped "
                "on its holder, or something touched it. Fix it if it may go on. The views are of use: "
                "`beamline recon` corrects those after the jump by shifts, or leaves them out (cones: choose one "
                "side with --views)."
            )
        elif abs(turn) > limit_turn:
            score, limit = turn, limit_turn
            advice = (
                f"The sample turned by {turn:+.1f} steps more than its step: triggers were lost, the stage slipped, or "
                "the sample turned on its holder. Compare the stage's encoder with the plan; `beamline recon` turns "
                "the views from here on to fit the others, or leaves them out."
            )
        else:
            return None
        return Look(replace(after, quiet=SPAN), Flag(self.name, Level.ALARM, row, score, limit, advice))
