"""Check `bands`: rows or columns that suddenly get darker or brighter than the others, for example after a lost packet.

The rotating sample changes the mean of a column from projection to projection, but hardly the mean of a row. The mean
intensity of each row and column of the preview is compared with the value expected from the projections before. If all
lines change, the beam has changed. A band begins if a few lines jump. The band lasts as long as these lines differ from
their neighbours as much as at its beginning.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from beamline.core.flag import PixelBox
from beamline.monitor.check import AGAIN, CheckResult, Flag, Level, Logged, ScanContext, intensity
from beamline.monitor.digest import FrameDigest
from drivers.base.frame import Frame, FrameKind
from recon.base.setting import setting

CALIBRATION = 5  # number of frames of a kind that are needed before frames are compared
BEFORE = 3  # number of frames over which the velocity of a line is averaged
MEMORY = 0.1  # weight of the newest frame in the usual change of a line
SIGMAS = 10.0
PATIENCE = 20  # flagged frames in a row after which the band is the new normal
NARROW = 0.25  # share of the lines: if more lines jump, the beam or the sample changed
REMAINS = 0.5  # share of the jump that remains while the band lasts
# share of the jump by which the lines must differ from both neighbours; an edge that passes is similar to one of them
STANDS_OUT = 0.25
LEAST_INTENSITY = 0.5  # counts

Lines = NDArray[np.float64]
Blocks = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Profile:
    """Rows or columns of the preview (lines), for one kind of frame.

    Attributes:
        last: logarithms of the intensity of each line in the last frames without a band, oldest first.
        change: usual change of each line that its velocity does not explain.
        blocks: [line, block] counts of the last frame without a band.
        first, after: first line of the present band, and the line after its last one; equal if there is no band.
        jump: change of the difference between the band and the lines next to it.
        flagged: number of frames in a row with this band.
    """

    last: tuple[Lines, ...] = ()
    change: Lines | None = None
    seen: int = 0
    blocks: Blocks = field(default_factory=lambda: np.empty((0, 0), np.float32))
    first: int = 0
    after: int = 0
    jump: float = 0.0
    flagged: int = 0

    def apart(self) -> Profile:
        """Prepare for a frame that is not a neighbour of the last one. Velocities must then be computed again from two
        frames."""
        return Profile((), self.change, min(self.seen, CALIBRATION - 3))


@dataclass(frozen=True, eq=False)
class BandsState:
    """Profiles [kind, axis] of the rows and of the columns, for projections and for flats."""

    projection: tuple[Profile, Profile] = field(default_factory=lambda: (Profile(), Profile()))
    flat: tuple[Profile, Profile] = field(default_factory=lambda: (Profile(), Profile()))


@dataclass(frozen=True)
class BandsCheck(Logged):
    """Score: fraction of the intensity that a preview row or column has lost (negative: gained).

    Reason for the default: if two black rows lie in two preview blocks of 8 rows, each block loses an eighth of its
    intensity.
    """

    name: ClassVar[str] = "bands"
    bit: ClassVar[int] = 3
    unit: ClassVar[str] = "fraction of the intensity in the row or column"
    meaning: ClassVar[str] = (
        "some rows or columns suddenly became darker or brighter, and the rest of the frame did not change"
    )

    alarm: float = setting(
        0.1,
        (
            "largest allowed loss of intensity in a row or column of the preview, compared with the other rows or "
            "columns, as a fraction"
        ),
        ge=0,
        lt=1,
    )

    start = BandsState

    def look(
        self, state: BandsState, frame: Frame, digest: FrameDigest, context: ScanContext
    ) -> CheckResult[BandsState]:
        if frame.kind is FrameKind.PROJECTION and context.view is not None:
            profiles, flag = self._both(
                state.projection, frame, (context.view.rows, context.view.cols), digest, context
            )
            return CheckResult(replace(state, projection=profiles), flag)
        if frame.kind is FrameKind.FLAT:
            counts = intensity(digest.preview, context)
            profiles, flag = self._both(state.flat, frame, (counts.mean(axis=1), counts.mean(axis=0)), digest, context)
            return CheckResult(replace(state, flat=profiles), flag)
        return CheckResult(state)

    def _both(
        self,
        profiles: tuple[Profile, Profile],
        frame: Frame,
        lines: tuple[Blocks, Blocks],
        digest: FrameDigest,
        context: ScanContext,
    ) -> tuple[tuple[Profile, Profile], Flag | None]:
        """Check the rows, then the columns. Returns the profiles after the frame, and the finding."""
        dark = np.zeros((1, 1), np.float32) if context.dark is None else context.dark
        dark = np.broadcast_to(dark, digest.preview.shape)
        if not context.follows:
            profiles = profiles[0].apart(), profiles[1].apart()
        rows, row_band = self._compare(profiles[0], lines[0], digest.preview, dark)
        cols, col_band = self._compare(profiles[1], lines[1], digest.preview.T, dark.T)
        if row_band is None and col_band is None:
            return (rows, cols), None
        block = math.sqrt(frame.counts.size / digest.preview.size)
        shape = frame.counts.shape
        score, limit, region, word = 0.0, 0.0, (0, 0, 0, 0), ""
        for band, axis in ((row_band, 0), (col_band, 1)):
            if band is not None and abs(band[2]) > abs(score):
                first, after = (min(round(line * block), shape[axis]) for line in band[:2])
                score, limit, word = band[2], band[3], ("rows", "columns")[axis]
                region = (first, after, 0, shape[1]) if axis == 0 else (0, shape[0], first, after)
        return (rows, cols), self._flag(frame.index, score, limit, region, word)

    def _flag(self, view: int, score: float, limit: float, region: PixelBox, word: str) -> Flag:
        first, after = region[:2] if word == "rows" else region[2:]
        last = after - 1
        darker_or_brighter = "darker" if score > 0 else "brighter"
        advice = (
            f"Check the link and the readout of the camera, and the slits: {word} {first} ... {last} suddenly became "
            f"up to {abs(score):.0%} {darker_or_brighter}, but the rest of the frame did not change. {AGAIN}"
        )
        return Flag(self.name, Level.ALARM, view, score, limit, advice, region)

    def _compare(
        self, profile: Profile, means: Blocks, blocks: Blocks, dark: Blocks
    ) -> tuple[Profile, tuple[int, int, float, float] | None]:
        """Compare the lines of a frame with earlier frames. Returns the profile after this frame, and (first, after,
        loss, limit)."""
        lines = np.log(np.maximum(means.astype(np.float64), LEAST_INTENSITY))
        if not profile.last or profile.last[-1].shape != lines.shape:
            if profile.change is not None and profile.change.shape == lines.shape:
                return Profile((lines,), profile.change, profile.seen + 1, blocks), None
            return Profile((lines,), np.zeros_like(lines), 1, blocks), None
        if profile.flagged:
            first, after, darker = profile.first, profile.after, profile.jump < 0
            excess = _contrast(lines, first, after, darker) - _contrast(profile.last[-1], first, after, darker)
            if excess > REMAINS * abs(profile.jump) and profile.flagged < PATIENCE:
                band = first, after, -math.expm1(-excess if darker else excess), self.alarm
                return replace(profile, flagged=profile.flagged + 1), band
            return Profile((lines,), profile.change, profile.seen, blocks), None
        steps = len(profile.last) - 1
        velocity = (profile.last[-1] - profile.last[0]) / steps if steps else np.zeros_like(lines)
        change = lines - profile.last[-1] - velocity
        change -= np.median(change)  # a weaker beam makes all lines darker by the same factor
        assert profile.change is not None
        limit = np.maximum(-math.log1p(-self.alarm), SIGMAS * profile.change)
        jumped = np.flatnonzero(np.abs(change) > limit)
        if profile.seen >= CALIBRATION and 0 < jumped.size <= max(1, NARROW * lines.size):
            worst = int(jumped[np.argmax(np.abs(change[jumped]))])
            first, after = _run(jumped, worst)
            jump = float(change[worst])
            before, now = (_contrast(x, first, after, jump < 0) for x in (profile.last[-1], lines))
            along = _typical(blocks[worst] - dark[worst], profile.blocks[worst] - dark[worst]) * math.copysign(
                1.0, jump
            )
            if now > STANDS_OUT * abs(jump) and min(now - before, along) > REMAINS * abs(jump):
                band = first, after, -math.expm1(jump), -math.expm1(-float(limit[worst]))
                return replace(profile, first=first, after=after, jump=jump, flagged=1), band
        weight = max(MEMORY, 1 / (profile.seen + 1))
        usual = profile.change + weight * (np.abs(change) - profile.change)
        return Profile((*profile.last, lines)[-1 - BEFORE :], usual, profile.seen + 1, blocks), None


def _run(lines: NDArray[np.intp], inside: int) -> tuple[int, int]:
    """First line, and the line after the last one, of the unbroken run of `lines` around one of them."""
    breaks = np.flatnonzero(np.diff(lines) > 1)
    starts, ends = np.append(0, breaks + 1), np.append(breaks, lines.size - 1)
    which = int(np.searchsorted(lines[ends], inside))
    return int(lines[starts[which]]), int(lines[ends[which]]) + 1


def _contrast(lines: Lines, first: int, after: int, darker: bool) -> float:
    """Difference in log intensity between the darkest (or brightest) of some lines and the lines on both sides.

    At an edge of the sample, the value is between the values of the two sides; at the edge of the frame there is only
    one side. The outer lines of a band may be only partly in the band.
    """
    left, right = lines[max(first - 1, 0) : first], lines[after : after + 1]
    neighbours = [float(side.mean()) for side in (left, right) if side.size]
    own = float(lines[first:after].min() if darker else lines[first:after].max())
    if not neighbours:
        return 0.0
    return min(neighbours) - own if darker else own - max(neighbours)


def _typical(now: Blocks, before: Blocks) -> float:
    """Median change of the log intensity along a line. The median ignores zingers."""
    return float(np.median(np.log(np.maximum(now, LEAST_INTENSITY)) - np.log(np.maximum(before, LEAST_INTENSITY))))
