"""Check `ghost`: a broad shadow or reflection that crosses the field of view from side to side.

As in the check `floater`, filters suppress everything that rotates with the stage (`fan`). Here the filters use the
mean of all rows in broad columns, because a moving shadow is as broad as a part of the field of view. In a single cell,
2 % of the intensity are below the noise; in the mean of thousands of pixels, 2 % are a hundred times the noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from beamline.monitor.check import CheckResult, Flag, Level, Logged, ScanContext, again_by
from beamline.monitor.digest import FrameDigest
from beamline.monitor.view import CellValues, sums_of_places
from drivers.base.frame import Frame
from recon.base.arrays import median_deviation
from recon.base.setting import setting

Reals = NDArray[np.float64]
REACH = 6  # number of cells of a window on each side of its middle
FREQUENCIES = 120  # number of frequencies, up to Nyquist, over which the covariance is summed
# frequency (2 pi cycles per cell) below which the spectrum of the sample is flat; above it, the spectrum falls with the
# third power
ROUGHNESS = 0.05
CONSTANT = 1.0  # variance of constant differences, such as rings or flats that do not match
COLUMNS = 32  # number of broad columns in the field of view
PARTS = 8  # parts of the rows
MOST_PARTS = 25.0  # percentile of the parts that must show the change
# share of the mean that these parts must have: a moving shadow is as high as the frame, a particle is only in some
# parts
ALIKE = 0.25
LAGS = (-4, -3, -2, -1, 0)  # factor on the stride
# rad: 3 projections at steps of 0.2 degrees; while the sample rotates by four times this angle, its points move on
# nearly straight lines
SWEEP = 0.0105
MOST_STRIDE = 3
WIDTHS = (1 / 7, 1 / 3.5)  # half width of the foot of the hump, as a share of the field of view
CROSSINGS = (8, 14, 24, 40, 70)  # projections from the first change in the field of view by the hump to the last one
STRUCTURE, COMMON = 0.3, 0.05**2
MARGIN = 1.2
WIDER = 2.2  # the same as for a loose particle
FASTER = 1.3
# if the output for a shadow at the limit is below this number of standard deviations, this filter is left out
SHOWS = 4.0
CALIBRATION = 24  # projections
LEAST_NOISE = 3e-4
MEMORY, OUTLIER = 0.03, 3.0
PEAK = 5.0
# largest number of projections of a trail, smallest number with a peak, and smallest share with a peak
SPAN, LEAST, SHARE = 10, 4, 0.6
# in broad columns: largest distance of a peak from its trail; per projection, added to the speed of the sample
OFF, SLACK = 2.5, 0.15


@dataclass(frozen=True)
class Clutter:
    """The signals other than moving shadows, which the filters suppress."""

    speed: float  # cells per projection by which the fastest point of the sample moves
    structure: float  # variance of the line integrals of the sample on the scale of the window
    common: float  # variance of changes of a whole row or projection, such as changes of the beam
    noise: float  # variance of the noise of a cell


def window(lags: tuple[int, ...]) -> tuple[Reals, Reals]:
    """Projection and column of each place of a window [lag, 2 REACH + 1], flattened, relative to its middle."""
    views, cols = np.meshgrid(np.array(lags, float), np.arange(-REACH, REACH + 1.0), indexing="ij")
    return views.ravel(), cols.ravel()


def covariance(lags: tuple[int, ...], clutter: Clutter) -> Reals:
    """Covariance [place, place] of a window, for patterns of all speeds in the fan, measured in square cells."""
    frequency = (np.arange(FREQUENCIES) + 0.5) / FREQUENCIES * np.pi
    power = np.sinc(frequency / (2 * np.pi)) ** 2 / (frequency**2 + ROUGHNESS**2) ** 1.5
    power /= power.sum()
    views, cols = window(lags)
    later, col_distance = views[:, None] - views, cols[:, None] - cols
    ages, widths = np.unique(np.abs(later)), np.arange(2 * REACH + 1.0)
    # The mean of cos(f (x - v t)) over speeds |v| <= limit is cos(f x) sinc(f limit t).
    blurred = power * np.sinc(frequency * clutter.speed * ages[:, None] / np.pi)
    table = blurred @ np.cos(frequency[:, None] * widths)
    structure = table[np.searchsorted(ages, np.abs(later)), np.abs(col_distance).astype(int)]
    return clutter.structure * structure + CONSTANT + clutter.common * (later == 0) + clutter.noise * np.eye(views.size)


@dataclass(frozen=True, eq=False)
class Filters:
    """Matched filters for several signals."""

    # weights: float32 [signal, lag, column]; for the assumed clutter and noise, the output of each filter has the
    # variance 1
    weights: CellValues
    strength: Reals  # float64 [signal], output for a signal of amplitude 1
    speeds: Reals  # float64 [signal], cells per projection


def filters(lags: tuple[int, ...], clutter: Clutter, signals: Reals, speeds: Reals) -> Filters:
    """Matched filters of `signals` float64 [signal, place]."""
    solved = np.linalg.solve(covariance(lags, clutter), signals.T).T
    strength = np.sqrt(np.einsum("sp,sp->s", signals, solved))
    weights = (solved / strength[:, None]).reshape(len(signals), len(lags), 2 * REACH + 1)
    return Filters(np.ascontiguousarray(weights, np.float32), strength, speeds)


def correlate(views: CellValues, weights: CellValues) -> CellValues:
    """Correlation [signal, row, col] of views [lag, row, col]; beyond the frame's edges the edge value is continued."""
    wide = np.pad(views, ((0, 0), (0, 0), (REACH, REACH)), mode="edge")
    places = np.lib.stride_tricks.sliding_window_view(wide, 2 * REACH + 1, axis=2)
    return np.tensordot(weights, places, ((1, 2), (0, 3)))


class Peak(NamedTuple):
    """The largest output in a projection: its broad column, and its score with sign."""

    view: int
    col: float
    score: float


class Trail(NamedTuple):
    """Peaks on a straight line in time that move faster than any part of the sample: first projection, and broad
    columns per projection."""

    first: int
    speed: float


@dataclass(frozen=True, eq=False)
class GhostState:
    # float32 [part of the rows, broad column] of the last projections, oldest first
    profiles: tuple[CellValues, ...] = ()
    angle: float = math.nan
    filters: Filters | None = None  # for the angle's `step` in radians
    step: float = math.nan
    usual: CellValues | None = None  # usual output of the filters at each column; None before the first output
    peaks: tuple[Peak, ...] = ()  # peaks of the last projections, oldest first


@dataclass(frozen=True)
class GhostCheck(Logged):
    """Score: absolute relative change of the intensity in the middle of the shadow or reflection. It has no sign,
    because in the few projections of a window, a reflection that leaves a place looks like a shadow that arrives."""

    name: ClassVar[str] = "ghost"
    bit: ClassVar[int] = 11
    unit: ClassVar[str] = "relative change of the intensity"
    meaning: ClassVar[str] = (
        "a broad shadow or reflection crosses the field of view and does not rotate with the sample"
    )

    warn: float = setting(
        0.01, "relative change in the middle of the shadow or reflection above which there is a warning", ge=0
    )
    alarm: float = setting(0.8, "relative change above which there is an alarm", ge=0)

    start = GhostState

    def look(
        self, state: GhostState, frame: Frame, digest: FrameDigest, context: ScanContext
    ) -> CheckResult[GhostState]:
        view, grid = context.view, context.grid
        if view is None or grid is None or view.depth.shape[1] < COLUMNS:
            return CheckResult(state)
        if context.change is None:
            return CheckResult(GhostState((_profiles(view.depth, view.weight),), view.angle))
        step = abs(view.angle - state.angle)
        profiles = (*state.profiles, _profiles(view.depth, view.weight))
        state = replace(state, profiles=profiles[-max(CALIBRATION, -LAGS[0] * MOST_STRIDE + 1) :], angle=view.angle)
        if len(profiles) < CALIBRATION:
            return CheckResult(state)
        stride = max(1, min(MOST_STRIDE, round(SWEEP / max(step, 1e-9))))
        radius = COLUMNS / 2 * (WIDER if context.truncated else 1.0)
        if state.filters is None or not abs(radius * step / state.step - 1) < 0.2:
            designed = _designed(radius * step, stride, _noise(state.profiles, stride), self.warn)
            state = replace(state, filters=designed, step=radius * step, usual=None)
        assert state.filters is not None
        if not state.filters.speeds.size:
            return CheckResult(state)
        chosen = np.stack([state.profiles[-1 + lag * stride] for lag in LAGS])
        outputs = correlate(chosen, state.filters.weights)
        return self._judge(state, frame.index, outputs, radius * step / (COLUMNS / 2), context)

    def _judge(
        self, state: GhostState, now: int, outputs: CellValues, turn: float, context: ScanContext
    ) -> CheckResult[GhostState]:
        """The largest output, relative to the usual output at that place, and the peaks of earlier projections."""
        assert state.filters is not None and context.grid is not None
        parts, outputs = outputs, outputs.mean(axis=1)
        spread = np.sqrt(np.mean(outputs**2, axis=0))
        usual = np.maximum(spread, 1.0) if state.usual is None else state.usual
        scores = outputs / np.maximum(usual, 1.0)
        signal, col = np.unravel_index(np.abs(scores).argmax(), scores.shape)
        score, depth = float(scores[signal, col]), float(outputs[signal, col] / state.filters.strength[signal])
        old = tuple(peak for peak in state.peaks if peak.view >= now - SPAN)
        usual = usual + np.float32(MEMORY) * (np.minimum(spread, OUTLIER * usual) - usual)
        state = replace(state, usual=usual, peaks=old)
        if abs(score) <= PEAK or abs(depth) <= self.warn:
            return CheckResult(state)
        if np.percentile(parts[signal, :, col] / outputs[signal, col], MOST_PARTS) <= ALIKE:
            return CheckResult(state)
        peaks = (*old, Peak(now, float(col), score))
        state = replace(state, peaks=peaks)
        trail = best_trail(peaks, FASTER * turn)
        if trail is None:
            return CheckResult(state)
        intensity = abs(math.expm1(-depth))
        level, limit = (Level.ALARM, self.alarm) if intensity > self.alarm else (Level.WARN, self.warn)
        rows, cols = context.grid.shape
        broad = cols / COLUMNS
        region = context.grid.region((rows - 1) / 2, (col + 0.5) * broad, rows, 2 * WIDTHS[0] * cols)
        speed_px = abs(trail.speed) * broad * context.grid.cell
        advice = (
            "Look for something between source and detector that reflects or shadows the beam and moves with the "
            "stage: a broad shadow or reflection crosses the field of view. The shadow or reflection changes the "
            f"intensity by {intensity:.1%} and moves {speed_px:.0f} px per projection, faster than any part of the "
            "sample. " + again_by(self.name)
        )
        return CheckResult(state, Flag(self.name, level, now, intensity, limit, advice, region, trail.first))


def _profiles(depth: CellValues, weight: CellValues) -> CellValues:
    """Mean line integral [part of the rows, broad column] of the cells with beam."""
    exposed = (weight > 0).astype(np.float32)
    sums, exposed = (sums_of_places(each, min(PARTS, depth.shape[0]), COLUMNS) for each in (depth, exposed))
    return np.asarray(sums / np.maximum(exposed, 1), np.float32)


def _noise(profiles: tuple[CellValues, ...], stride: int) -> float:
    """Noise of a profile, including irregular changes of the sample, from second differences over `stride`
    projections."""
    profile_means = np.stack([profile.mean(axis=0) for profile in profiles])
    second = profile_means[2 * stride :] - 2 * profile_means[stride:-stride] + profile_means[: -2 * stride]
    return max(median_deviation(second) / math.sqrt(6.0), LEAST_NOISE)


def _designed(rim: float, stride: int, noise: float, limit: float) -> Filters:
    """The filters for a sample whose rim moves `rim` broad columns per projection."""
    views, cols = window(LAGS)
    signals, speeds = [], []
    for width in WIDTHS:
        for crossing in CROSSINGS:
            for sign in (-1.0, 1.0):
                speed = sign * COLUMNS * (1 + 2 * width) / crossing
                if abs(speed) > FASTER * rim:
                    position = np.clip((cols - speed * stride * views) / (width * COLUMNS), -1, 1)
                    signals.append(np.cos(0.5 * np.pi * position) ** 2)
                    speeds.append(speed)
    clutter = Clutter(MARGIN * rim * stride, STRUCTURE, COMMON, noise**2)
    all_filters = filters(LAGS, clutter, np.array(signals).reshape(len(speeds), views.size), np.array(speeds))
    keep = all_filters.strength * 2 * limit > SHOWS
    return Filters(all_filters.weights[keep], all_filters.strength[keep], all_filters.speeds[keep])


def best_trail(peaks: Sequence[Peak], turn: float) -> Trail | None:
    """The trail with the largest sum of scores (one peak per projection) that ends at the last peak; None if there is
    no trail.

    A point of the sample at the distance x from the middle moves by less than turn sqrt(radius² - x²) per projection.
    `turn` is in radians per projection; x and the radius (half the field of view) are in broad columns.
    """
    best, best_total, last = None, 0.0, peaks[-1]
    alike = [peak for peak in peaks if peak.score * last.score > 0]
    for first in alike:
        age = last.view - first.view
        if age < LEAST - 1:
            break
        speed, from_middle = (last.col - first.col) / age, (last.col + first.col - COLUMNS + 1) / 2
        if abs(speed) < turn * math.sqrt(max((COLUMNS / 2) ** 2 - from_middle**2, 0.0)) + SLACK:
            continue
        since = [peak for peak in alike if peak.view >= first.view]
        near = [abs(p.score) for p in since if abs(p.col - (last.col - speed * (last.view - p.view))) <= OFF]
        if len(near) >= max(LEAST, SHARE * (age + 1)) and (total := sum(near)) > best_total:
            best, best_total = Trail(first.view, speed), total
    return best
