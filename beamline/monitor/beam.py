"""Check `beam`: slow and sudden changes of the beam intensity, relative to the flats.

A slow change (drift) is measured in air, in the brightest part of a projection. It is reported when it starts, and as
info each time it has doubled. A sudden change is measured from projection to projection (beamline.monitor.change),
which needs no air. If dense particles rotate quickly, the measured changes have errors of one sign, and the sum of
these errors would look like a loss of beam. Therefore a change counts only if the intensity of the whole projection has
changed, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from beamline.monitor.change import FrameScatter, SampleChange
from beamline.monitor.check import CheckResult, Flag, Level, Logged, ScanContext, exposure_ratio, intensity
from beamline.monitor.digest import FrameDigest
from beamline.monitor.view import COVERED, DRIFT_STEP, CellGrid, CellView, brightest_place
from drivers.base.frame import Frame, FrameKind
from recon.base.setting import setting

LASTS = 5  # number of projections for which a drift must last
GROWN = 2.0  # factor on the reported drift at which it is reported again
REMEDY = (
    "`beamline recon` corrects this change of the beam if there is air next to the sample (--air auto). Flats "
    "before and after the projections (scan.flats.at: both) also correct the change."
)
TAKEN_OFF = "`beamline recon` corrects this error if there is air next to the sample (--air auto)."
GONE = 0.5  # a drift has ended if it is below this share of the limit
PATIENCE = 20  # views after which a dip is the new normal
MEMORY = 0.05  # weight of the newest view in the usual intensity
# share of a change that the intensity of the whole projection must show; the rest may come from the rotation of the
# sample
CONFIRMED = 0.5
SIGMAS = 6.0  # smallest size of a dip, in standard deviations of the changes


@dataclass(frozen=True)
class BeamState:
    drifting: int = 0  # number of successive projections that would change the report
    flagged_drift: float = 0.0  # the drift that was flagged last; 0: no drift was flagged, or it has ended
    covered: bool = False  # True if the missing air was reported
    level: float = 0.0  # logarithm of the intensity over that of the first view, from its confirmed changes
    usual: float = 0.0  # the normal level
    dipping: int = 0  # number of successive projections with a dip
    whole: float = math.nan  # logarithm of the intensity of the whole previous projection; NaN if there is none
    # changes: usual changes of the intensity from projection to projection. Each change counts as at most half of
    # `alarm`, so that a single dip does not count as scatter. The limit is therefore at most 3.8 times `alarm`
    changes: FrameScatter = field(default_factory=FrameScatter)


@dataclass(frozen=True)
class BeamCheck(Logged):
    """Score: fraction of the intensity that was lost (negative: gained).

    Reasons for the defaults: if it is not corrected with the air next to the sample, a change of the intensity by 2 %
    changes the line integral of every ray by 0.02. A sudden change of 10 % cannot be the drift of a storage ring.
    """

    name: ClassVar[str] = "beam"
    bit: ClassVar[int] = 0
    unit: ClassVar[str] = "fraction of the intensity in the flats"
    meaning: ClassVar[str] = "the beam intensity differs from the flats, or from the projections before"

    drift: float = setting(0.02, "largest allowed drift of the beam intensity, up or down, as a fraction", ge=0)
    dip: float = setting(0.10, "sudden loss of beam intensity above which there is an alarm, as a fraction", ge=0, lt=1)

    start = BeamState

    def look(self, state: BeamState, frame: Frame, digest: FrameDigest, context: ScanContext) -> CheckResult[BeamState]:
        if frame.kind is FrameKind.FLAT and context.flat is not None:
            full = float(intensity(context.flat, context).mean()) * exposure_ratio(context, frame.exposure)
            score = 1 - float(intensity(digest.preview, context).mean()) / full if full > 0 else 0.0
            return CheckResult(state, self._flat(frame.index, score))
        if context.view is None or context.grid is None:
            return CheckResult(state)
        state, flag = self._dip(state, frame.index, context.change, _whole(context.view, context.grid))
        if flag is None and context.grid.flats and not state.dipping:
            looked = self._drift(state, frame.index, brightest_place(context.view, context.grid), in_air(context))
            state, flag = looked.state, looked.flag
        return CheckResult(state, flag if flag is None or not context.integrals else _of_integrals(flag))

    def _flat(self, row: int, score: float) -> Flag | None:
        if abs(score) <= self.drift:
            return None
        level, limit = (Level.ALARM, self.dip) if abs(score) > self.dip else (Level.WARN, self.drift)
        change_in_words = _size(score)
        advice = f"Usually nothing to do: this flat is {change_in_words} than the flats before. {REMEDY}"
        return Flag(self.name, level, row, score, limit, advice)

    def _dip(
        self, state: BeamState, row: int, change: SampleChange | None, whole: float
    ) -> tuple[BeamState, Flag | None]:
        """A dip or a flash of more than `dip` is flagged in every projection, until it has ended or has become the
        normal intensity."""
        moved, state = whole - state.whole, replace(state, whole=whole)
        if change is None:
            return state, None
        brighter = math.log1p(change.gain)
        level = state.level + (brighter if brighter * moved > CONFIRMED * brighter**2 else 0.0)
        score = -math.expm1(level - state.usual)
        limit = max(self.dip, SIGMAS * state.changes.sigma)
        largest_change = self.dip / 2
        state = replace(
            state, level=level, changes=state.changes.with_figure(min(max(brighter, -largest_change), largest_change))
        )
        if abs(score) <= limit or state.dipping >= PATIENCE:
            usual = level if state.dipping >= PATIENCE else state.usual + MEMORY * (level - state.usual)
            return replace(state, usual=usual, dipping=0), None
        change_in_words = _size(score)
        advice = (
            f"Check ring current, slits and filters, and take new flats: this projection is {change_in_words} than the "
            "projections before."
        )
        return replace(state, dipping=state.dipping + 1), Flag(self.name, Level.ALARM, row, score, limit, advice)

    def _drift(self, state: BeamState, row: int, brightest: float, air: float) -> CheckResult[BeamState]:
        score = -math.expm1(-brightest)
        if math.isnan(air):
            if state.covered:
                return CheckResult(replace(state, drifting=0))
            advice = (
                "The drift of the beam cannot be measured, because no part of the frame gets more than "
                f"{1 - score:.0%} of the intensity in the flats. The sample covers the whole frame, or the beam is "
                "weaker than in the flats."
            )
            return CheckResult(replace(state, covered=True), Flag(self.name, Level.INFO, row, score, COVERED, advice))
        has_ended = state.flagged_drift != 0 and abs(score) < GONE * self.drift
        if not has_ended and abs(score) <= max(GROWN * abs(state.flagged_drift), self.drift):
            return CheckResult(replace(state, drifting=0))
        if state.drifting + 1 < LASTS:
            return CheckResult(replace(state, drifting=state.drifting + 1))
        if has_ended:
            return CheckResult(replace(state, drifting=0, flagged_drift=0.0))
        # a drift that continues does not make the projection worse
        level = Level.INFO if state.flagged_drift else Level.WARN
        change_in_words = _size(score)
        advice = f"Usually nothing to do: air is {change_in_words} than in the flats. {REMEDY}"
        flag = Flag(self.name, level, row, score, self.drift, advice)
        return CheckResult(replace(state, drifting=0, flagged_drift=score), flag)


def in_air(context: ScanContext) -> float:
    """Line integral of the brightest part of a projection, which is the loss of beam since the flats. NaN if this part
    may show the sample, because its line integral is above COVERED and unlike that of the air so far."""
    if context.view is None or context.grid is None or not context.grid.flats:
        return math.nan
    brightest = brightest_place(context.view, context.grid)
    return brightest if brightest <= COVERED or abs(brightest - context.dimmer) <= DRIFT_STEP else math.nan


def _of_integrals(flag: Flag) -> Flag:
    """The flag for a file without counts and flats, for which the intensity is not known."""
    line_integral = -math.log1p(-flag.score) if flag.score < 1 else math.inf
    if flag.limit == COVERED:
        advice = (
            f"No line integral of the frame is below {line_integral:.3g}: either the sample covers the whole frame, or "
            "the line integral of air is not 0."
        )
    else:
        advice = (
            f"Line integrals are wrong by {line_integral:+.3g}, compared with 0 in air or with the projections before. "
            f"{TAKEN_OFF}"
        )
    return replace(flag, advice=advice)


def _size(score: float) -> str:
    return f"{abs(score):.1%} {'darker' if score > 0 else 'brighter'}"


def _whole(view: CellView, grid: CellGrid) -> float:
    """Logarithm of the mean transmission of the cells with beam; NaN if there are no such cells."""
    exposed = grid.exposed > 0
    return math.log(float(np.exp(-view.depth[exposed]).mean())) if exposed.any() else math.nan
