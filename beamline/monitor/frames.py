"""Checks of single frames: `saturation`, `stuck` (repeated images), `timing`, `dark` (drift of darks), `lost` (beam).

Noise never repeats exactly, so two frames with the same checksum are the same frame, delivered twice. By default, only
alarms of `lost` stop a scan.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import nan
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from beamline.core.text import count
from beamline.monitor.check import AGAIN, CheckResult, Flag, Level, Logged, Policy, ScanContext
from beamline.monitor.digest import FrameDigest, subsampled
from drivers.base.frame import Frame, FrameKind
from recon.base.setting import setting

FEW_PIXELS = 2  # fewer saturated pixels may be hot pixels that the darks did not show


@dataclass(frozen=True)
class SaturationState:
    """State. hot: fraction of the pixels that are saturated even without beam."""

    hot: float = 0.0


@dataclass(frozen=True)
class SaturationCheck(Logged):
    """Score: fraction of saturated pixels, minus the fraction that is also saturated in the darks."""

    name: ClassVar[str] = "saturation"
    bit: ClassVar[int] = 1
    unit: ClassVar[str] = "fraction of the pixels"
    meaning: ClassVar[str] = "more pixels are saturated than in the darks"

    warn: float = setting(1e-5, "fraction of saturated pixels above which there is a warning", ge=0)
    alarm: float = setting(1e-3, "fraction of saturated pixels above which there is an alarm", ge=0)

    start = SaturationState

    def look(
        self, state: SaturationState, frame: Frame, digest: FrameDigest, context: ScanContext
    ) -> CheckResult[SaturationState]:
        if frame.kind is FrameKind.DARK:
            return CheckResult(SaturationState(max(state.hot, digest.saturated_fraction)))
        score = digest.saturated_fraction - state.hot - context.spots.saturated / context.pixels
        if score <= max(self.warn, FEW_PIXELS / context.pixels):
            return CheckResult(state)
        level, limit = (Level.ALARM, self.alarm) if score > self.alarm else (Level.WARN, self.warn)
        advice = (
            f"Shorten the exposure or add a filter: {score:.2%} of the pixels are saturated (at least "
            f"{context.saturation:g} counts)."
        )
        return CheckResult(state, Flag(self.name, level, frame.index, score, limit, advice))


@dataclass(frozen=True)
class StuckState:
    """Checksum and metadata of the previous frame.

    Attributes:
        checksum, angle: of the previous frame.
        repeats: number of frames in a row with this checksum.
        noiseless: True if darks or flats of a single grey value repeat, as in a simulation without noise.
    """

    checksum: int | None = None
    angle: float = nan
    repeats: int = 0
    noiseless: bool = False


@dataclass(frozen=True)
class StuckCheck(Logged):
    """Score: number of successive repetitions. There are no limits, because a single repetition is an alarm."""

    name: ClassVar[str] = "stuck"
    bit: ClassVar[int] = 2
    unit: ClassVar[str] = "repetitions"
    meaning: ClassVar[str] = "the image is identical to the previous image: the camera delivered a frame twice"

    start = StuckState

    def look(
        self, state: StuckState, frame: Frame, digest: FrameDigest, context: ScanContext
    ) -> CheckResult[StuckState]:
        """Compare checksums. In a simulation without noise, darks or flats are equal, and so are the frames of a
        projection."""
        plain = digest.variance == 0 and frame.kind is not FrameKind.PROJECTION
        alike = digest.checksum == state.checksum
        as_before = frame.kind is not FrameKind.PROJECTION or frame.angle == state.angle
        state = replace(
            state, checksum=digest.checksum, angle=frame.angle, noiseless=state.noiseless or (plain and alike)
        )
        if not alike or plain or (state.noiseless and as_before):
            return CheckResult(replace(state, repeats=0))
        state = replace(state, repeats=state.repeats + 1)
        advice = (
            "Stop and restart the camera: the camera or its driver delivers the same image again, "
            f"{count(state.repeats, 'time')} in a row (all pixels are identical)."
        )
        return CheckResult(state, Flag(self.name, Level.ALARM, frame.index, state.repeats, 0, advice))


@dataclass(frozen=True)
class TimingState:
    """Trigger, framestamp and time of the previous projection; -1 before the first. gaps: number of triggers without a
    frame."""

    trigger: int = -1
    framestamp: int = -1
    time: float = 0.0
    gaps: tuple[range, ...] = ()


@dataclass(frozen=True)
class TimingCheck(Logged):
    """Score: delay of the frame in units of the period (negative: early).

    If earlier triggers gave no frame, the flag is only an INFO, because the frame after the gap is good.
    """

    name: ClassVar[str] = "timing"
    bit: ClassVar[int] = 4
    unit: ClassVar[str] = "trigger periods"
    meaning: ClassVar[str] = "the frame came early or late (fly scans)"

    warn: float = setting(
        0.25,
        "how early or late a frame may arrive without a warning, as a fraction of the time between two projections",
        ge=0,
    )

    start = TimingState

    def look(
        self, state: TimingState, frame: Frame, digest: FrameDigest, context: ScanContext
    ) -> CheckResult[TimingState]:
        steps = frame.trigger - state.trigger
        # A projection that is taken again replaces a frame or fills a gap. The stage is at rest for it.
        alone = frame.replaces >= 0 or (steps < 1 and any(frame.trigger in gap for gap in state.gaps))
        if frame.kind is not FrameKind.PROJECTION or context.period is None or alone:
            return CheckResult(state)
        after = TimingState(frame.trigger, frame.framestamp, frame.time, state.gaps)
        lost = steps - 1 - sum(state.trigger < view < frame.trigger for view in context.stored)
        if lost > 0:
            after = replace(after, gaps=(*state.gaps, range(state.trigger + 1, frame.trigger)))
            advice = (
                f"{count(lost, 'frame')} missing before this frame: either the trigger did not start an exposure, or "
                "the frame was lost."
            )
            return CheckResult(after, Flag(self.name, Level.INFO, frame.index, lost, 0, advice))
        if state.trigger < 0 or steps < 1 or 0 <= frame.framestamp <= state.framestamp:
            # the camera was armed again: for another pass, for the same pass again, or after a pause
            return CheckResult(after)
        score = (frame.time - state.time) / context.period - steps
        if abs(score) <= self.warn:
            return CheckResult(after)
        late_or_early = "late" if score > 0 else "early"
        periods = abs(score)
        advice = (
            f"Check the stage and the trigger line: the frame came {periods:.0%} of a period too {late_or_early}. "
            "Either the stage does not turn evenly, or the trigger line picks up noise."
        )
        return CheckResult(after, Flag(self.name, Level.WARN, frame.index, score, self.warn, advice))


# one of this many preview blocks is left out at either end, because of zingers, which have nothing to do with the
# camera
TRIM = 10


@dataclass(frozen=True, eq=False)
class DarkState:
    """Preview blocks of the first dark; None before the first dark."""

    blocks: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class DarkCheck(Logged):
    """Score: drift in counts. (`beamline.monitor.references` finds darks that were exposed to the beam.)

    The drift is a trimmed mean over the blocks of the preview, because one zinger changes the mean of a small frame by
    tens of counts.
    """

    name: ClassVar[str] = "dark"
    bit: ClassVar[int] = 6
    unit: ClassVar[str] = "counts of drift"
    meaning: ClassVar[str] = "a dark differs from the first one"

    drift: float = setting(5.0, "largest allowed difference between a dark and the first dark, in counts", ge=0)

    start = DarkState

    def look(self, state: DarkState, frame: Frame, digest: FrameDigest, context: ScanContext) -> CheckResult[DarkState]:
        if frame.kind is not FrameKind.DARK:
            return CheckResult(state)
        blocks = subsampled(digest.preview)
        if state.blocks is None:
            return CheckResult(DarkState(blocks))
        drift = _trimmed_mean(blocks - state.blocks)
        if abs(drift) <= self.drift:
            return CheckResult(state)
        advice = (
            f"Check the cooling of the camera, and for stray light: the dark level changed by {drift:+.1f} counts "
            "since the first dark."
        )
        return CheckResult(state, Flag(self.name, Level.WARN, frame.index, drift, self.drift, advice))


def _trimmed_mean(values: NDArray[np.float32]) -> float:
    """Mean without some of the lowest and highest values (at least one of each, if there are three values)."""
    ordered = np.sort(values, axis=None)
    cut = min(max(1, ordered.size // TRIM), (ordered.size - 1) // 2)
    return float(ordered[cut : ordered.size - cut].mean())


@dataclass(frozen=True)
class LostState:
    """This check has no state, because the monitor itself keeps the last good projection."""


@dataclass(frozen=True)
class LostCheck:
    """Score: fraction of the intensity that was lost in nine tenths of the frame, relative to the last projection with
    beam.

    Reason for the default: neither drift nor the decay of the ring current between two top-ups removes half of the
    intensity. A rotating sample does not darken all places at once.
    """

    name: ClassVar[str] = "lost"
    bit: ClassVar[int] = 7
    unit: ClassVar[str] = "fraction of the intensity"
    meaning: ClassVar[str] = "the beam is gone"
    policy: ClassVar[Policy] = Policy.STOP

    alarm: float = setting(
        0.5, "the beam counts as lost if the intensity falls by at least this fraction", ge=0.5, le=1
    )

    start = LostState

    def look(self, state: LostState, frame: Frame, digest: FrameDigest, context: ScanContext) -> CheckResult[LostState]:
        score = 1 - context.light_left
        if frame.kind is not FrameKind.PROJECTION or score <= self.alarm:
            return CheckResult(state)
        empty = (
            "Look at the file: every pixel of this frame has the same value. The frame was never written, or the "
            "camera sent no frame."
        )
        advice = (
            f"Check ring current, front end and shutter: the beam is lost ({score:.0%} of the intensity is gone). "
            f"{AGAIN}"
            if digest.variance
            else empty
        )
        return CheckResult(state, Flag(self.name, Level.ALARM, frame.index, score, self.alarm, advice))
