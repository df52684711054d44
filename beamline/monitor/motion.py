"""Check `motion`: finds jumps, slips and shaking of the sample, beyond its steady rotation.

Shaking is random displacement from projection to projection, caused by vibration or runout of the stage. If a
projection is displaced by x, its own change relative to earlier projections is x. The change of the next projection is
-4/3 x, because the displaced projection is then the previous one and also makes a third of the velocity. Therefore
consecutive changes have a covariance of -4/3 of the variance of x. Errors of the model of the rotating sample change
slowly, so their covariance is positive. The sign of the covariance distinguishes the two for every sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import ClassVar

from beamline.monitor.change import SPAN, FrameScatter, SampleChange
from beamline.monitor.check import CheckResult, Flag, Level, Logged, ScanContext
from beamline.monitor.digest import FrameDigest
from drivers.base.frame import Frame
from recon.base.setting import setting

PAIRS = 32  # number of consecutive changes that are needed before anything is reported
SHAKE_MEMORY = 0.02  # weight of the newest pair
# largest number of mean absolute deviations with which a change counts: a jump must not count as vibration, and noise
# must keep its variance
CLIPPED = 4.0
OWN = 4 / 3  # minus the covariance of consecutive changes, in units of the variance of x
# standard deviation of a change, divided by that of the displacement of a projection
FROM_NOISE = math.sqrt(1 + OWN**2 + 1 / 9)
SHAKE_SIGMAS = 6.0  # number of standard deviations of the estimate: one false alarm in 10**9 estimates
SHAKE_CONFIRMED = 0.5  # share of the variance of the changes that their covariance must have
# standard deviation of the estimate for noise alone, divided by the variance of the noise, times sqrt(number of pairs)
SPREAD = 2.6


@dataclass(frozen=True)
class Axis:
    """One direction of motion: usual and latest size of changes; running means of their squares, of products of
    consecutive ones, and of noise variances.
    """

    usual: FrameScatter = field(default_factory=FrameScatter)
    last: float = math.nan
    square: float = 0.0
    product: float = 0.0
    noise: float = 0.0

    def with_figure(self, figure: float, sigma: float, pairs: int) -> Axis:
        usual = self.usual.with_figure(figure)
        largest_difference = CLIPPED * max(usual.deviation, 1e-9)
        difference = min(max(figure - usual.mean, -largest_difference), largest_difference)
        if math.isnan(self.last):
            return replace(self, usual=usual, last=difference)
        weight = max(SHAKE_MEMORY, 1 / (pairs + 1))
        square = self.square + weight * (difference**2 - self.square)
        product = self.product + weight * (difference * self.last - self.product)
        noise = self.noise + weight * ((sigma / FROM_NOISE) ** 2 - self.noise)
        return Axis(usual, difference, square, product, noise)

    def size(self, pairs: int) -> float:
        """Size of the shaking: standard deviation in pixels without the noise; 0 if noise alone can explain it.

        The squares give the size more precisely than the products, but count only if the products confirm it.
        """
        variance, n = -self.product / OWN, min(pairs, round(2 / SHAKE_MEMORY))
        if pairs < PAIRS or variance < self.noise * (1 + SHAKE_SIGMAS * SPREAD / math.sqrt(n)):
            return 0.0
        whole = self.square / FROM_NOISE**2
        return math.sqrt(max(whole if variance > SHAKE_CONFIRMED * whole else variance, self.noise) - self.noise)


@dataclass(frozen=True)
class Shake:
    """Shaking across and down, measured from the projections so far."""

    across: Axis = field(default_factory=Axis)
    down: Axis = field(default_factory=Axis)
    pairs: int = 0

    def with_change(self, change: SampleChange | None) -> Shake:
        """The state after the next projection. None, or a gap between projections, begins a new chain of changes."""
        if change is None or not 0.5 < change.steps < 1.5 or not math.isfinite(change.across + change.down):
            return Shake(replace(self.across, last=math.nan), replace(self.down, last=math.nan), self.pairs)
        figures = (change.across, change.sigma[0]), (change.down, change.sigma[1])
        across, down = (
            axis.with_figure(*figure, self.pairs)
            for axis, figure in zip((self.across, self.down), figures, strict=True)
        )
        return Shake(across, down, self.pairs + (not math.isnan(self.across.last)))

    @property
    def size(self) -> tuple[float, float]:
        """Standard deviations across and down, in pixels."""
        return self.across.size(self.pairs), self.down.size(self.pairs)


SIGMAS = 8.0
LEAST_SHAKE = 0.02  # share of a cell; smaller shaking is not reported on a large frame, whose cells have many pixels
# share of the limit below which shaking has ended; factor on the reported shaking above which it is reported again
GONE, GROWN = 0.5, 2.0
# share of a result; if a smaller part differs from row to row, only this part counts, because a moving shadow is as
# high as the frame
CONFIRMED = 0.5


@dataclass(frozen=True)
class MotionState:
    """State.

    Attributes:
        across, down: usual shifts in pixels.
        turn: usual excess rotation in steps.
        quiet: number of projections in which a jump still has an effect.
        told: size in pixels of the shaking that was flagged last; 0 if no shaking was flagged, or if it has ended.
    """

    across: FrameScatter = field(default_factory=FrameScatter)
    down: FrameScatter = field(default_factory=FrameScatter)
    turn: FrameScatter = field(default_factory=FrameScatter)
    quiet: int = 0
    flagged_shake: float = 0.0


@dataclass(frozen=True)
class MotionCheck(Logged):
    """Score: displacement of the sample in pixels, beyond its rotation; in steps of the stage if it is a slip.

    Only the projection of the jump is flagged, because later projections are as good as earlier ones and only show
    another position. Reasons for the defaults: if projections show two positions half a pixel apart, double edges
    become visible in a reconstruction, because they are then as wide as the resolution. A flat face that rotates into
    the beam direction looks like a slip of up to two steps. Shaking gives one warning, and another when it has doubled:
    a quarter of a pixel removes a quarter of the contrast of the finest detail (two pixels).
    """

    name: ClassVar[str] = "motion"
    bit: ClassVar[int] = 9
    unit: ClassVar[str] = "pixels, or steps of the stage"
    meaning: ClassVar[str] = (
        "the sample jumped or slipped (alarm), or shakes (warning): projections do not fit together"
    )

    alarm: float = setting(0.5, "largest allowed shift of the sample between two projections, in pixels", ge=0)
    steps: float = setting(
        3.0, "largest allowed error of the rotation from one projection to the next, in angular steps", ge=0
    )
    shake: float = setting(0.25, "largest allowed shaking of the sample, in pixels (standard deviation)", ge=0)

    start = MotionState

    def look(
        self, state: MotionState, frame: Frame, digest: FrameDigest, context: ScanContext
    ) -> CheckResult[MotionState]:
        change = context.change
        if change is None:
            return CheckResult(state)
        after = MotionState(
            state.across.with_figure(change.across),
            state.down.with_figure(change.down),
            state.turn.with_figure(change.turn),
            max(state.quiet - 1, 0),
            state.flagged_shake,
        )
        if not state.across.ready or state.quiet:
            return CheckResult(after)
        jump = self._jump(state, after, frame.index, change)
        return self._shake(after, frame.index, context) if jump is None else jump

    def _shake(self, state: MotionState, row: int, context: ScanContext) -> CheckResult[MotionState]:
        assert context.grid is not None
        across, down = context.shake
        size, limit = math.hypot(across, down), max(self.shake, LEAST_SHAKE * context.grid.cell)
        if state.flagged_shake and size < GONE * limit:
            return CheckResult(replace(state, flagged_shake=0.0))
        if size <= max(limit, GROWN * state.flagged_shake):
            return CheckResult(state)
        advice = (
            f"Check for vibration and for runout of the stage: the sample shakes by {across:.2f} px horizontally and "
            f"{down:.2f} px vertically (standard deviation over at most the last 100 projections). The projections can "
            "still be used: `beamline recon --calibrate shifts` measures and corrects the shift of each projection."
        )
        return CheckResult(replace(state, flagged_shake=size), Flag(self.name, Level.WARN, row, size, limit, advice))

    def _jump(
        self, state: MotionState, after: MotionState, row: int, change: SampleChange
    ) -> CheckResult[MotionState] | None:
        """The flag for a jump or a slip; None if there is none."""
        usual = state.across, state.down, state.turn
        change_of_place = change.across, change.down, change.turn
        limits = self.alarm, self.alarm, self.steps
        limit_across, limit_down, limit_turn = (
            max(least, SIGMAS * s.sigma) for least, s in zip(limits, usual, strict=True)
        )
        across, down, turn = (x - s.mean for x, s in zip(change_of_place, usual, strict=True))
        over = abs(across) > limit_across or abs(down) > limit_down or abs(turn) > limit_turn
        if over and (beside_columns := change.beside_columns()) is not None:
            right, below, further = (x - s.mean for x, s in zip(beside_columns, usual, strict=True))
            if math.hypot(right, below) < CONFIRMED * math.hypot(across, down):
                across, down = right, below
            if abs(further) < CONFIRMED * abs(turn):
                turn = further
        if abs(across) > limit_across or abs(down) > limit_down:
            score, limit = math.hypot(across, down), min(limit_across, limit_down)
            advice = (
                f"Fix the sample if it may move again: the sample jumped by {across:+.1f} px horizontally and "
                f"{down:+.1f} px vertically between two projections, because it slipped on its holder or something "
                "touched it. The projections can still be used: `beamline recon` uses the longer part of the scan, "
                "before or after the jump. --calibrate shifts corrects the jump instead (in a cone beam choose one "
                "part with --views)."
            )
        elif abs(turn) > limit_turn:
            score, limit = turn, limit_turn
            advice = (
                "Compare the encoder of the stage with the plan: between two frames the sample rotated by "
                f"{turn:+.1f} angular steps more (+) or less (-) than planned. Triggers were lost, the stage "
                "slipped, or the sample turned on its holder. `beamline recon` uses only the longer part of the "
                "scan, either before or after this jump."
            )
        else:
            return None
        return CheckResult(replace(after, quiet=SPAN), Flag(self.name, Level.ALARM, row, score, limit, advice))
