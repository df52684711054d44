"""Finds the path (`Track`) of a small absorber through the field of view, from the sum over all projections that show
it.

The mean of the two neighbours is subtracted from each projection. The difference shows noise, and objects that move by
their own size or more from one projection to the next. The differences are summed along lines in (projection, column)
and divided by the standard deviation of the sum. This score grows as the square root of the number of projections if an
absorber moves along the line, and does not grow in noise (track before detect; Barniv 1985, IEEE Trans. AES 21:144). A
line ends at its largest score, which may be inside the field of view. Slower objects are visible in the means of 2, 4,
8 ... projections. Each of these numbers is called an *octave*.

A track does not belong to the sample if no point that rotates with the stage, within the radius of the sample, takes
this path. To decide this, the squares of two scores are compared: their difference is twice the logarithm of the ratio
of the likelihoods (Wilks 1938).

Lengths are in cells, times in projections.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from beamline.monitor.view import CellValues
from recon.base.arrays import median_deviation
from recon.base.jit import njit

SEED = 4  # number of steps of an octave from whose sum the continuation of a track is searched
# cells per step: slower objects mostly disappear when the neighbours are subtracted; faster ones are found in single
# projections
SLOWEST, SLOW = 1.5, 4.0
APART = 0.5  # cells per step between the speeds tried, so that the end of a seed is wrong by less than a cell
MEMORY = 48  # steps; at the speed SLOWEST an object crosses 120 cells in them
PROMISING = 4.0  # smallest number of standard deviations of a seed; noise gives a few such seeds in a projection
# largest number of seeds of a step; more seeds take time, and come from noise or from a sample that jumped
MOST_SEEDS = 8
CLIP = 5.0  # largest number of standard deviations that one step may add to a score
SIZE = 0.75  # cells: standard deviation of a ball of 6 px at 512 columns, 128 cells
KERNEL = np.exp(-0.5 * (np.arange(-2, 3) / SIZE) ** 2).astype(np.float32)
KERNEL /= np.sqrt((KERNEL**2).sum())  # white noise keeps its variance
KERNEL_ROWS = KERNEL[1:4] / np.sqrt((KERNEL[1:4] ** 2).sum())
SAMPLED = 3  # one of this many cells is enough to measure the noise
SPIKE = 6.0  # standard deviations: if the neighbours differ more, the brighter one has a zinger, or an edge passes
COMMON = 8  # number of cells of a row or column from which its common change is computed
# largest number of standard deviations that a cell adds to the common change of its row and to its usual deviation
OUTLIER = 3.0
FORGET = 0.1  # weight of the newest step in the usual square
LEAST_NOISE = 2e-3  # line integral: error of the flats and of the steps of the stage
LIT = 1e-3  # weight of a cell with almost no intensity
FINE = 0.5  # cells between the positions tried for each end of a track
REACH = 6.0  # largest distance in cells of a rival from the newest position
UNEVEN = 0.3  # fraction of its depth by which a track may vary: part of a particle may be outside the field of view
LONGER = 1.5  # factor on the number of steps in each round of a fit


@dataclass(frozen=True, eq=False)
class OctaveStep:
    """One step of an octave: the mean of some projections, compared with its two neighbours.

    Attributes:
        rows: rows of its first and last projection in the file.
        time: time of its middle, in projections.
        change: float32 [row, col], difference from the mean of the neighbours, smoothed to SIZE.
        noise: float32 [row, col], usual standard deviation of `change` in each cell.
    """

    rows: tuple[int, int]
    time: float
    change: CellValues
    noise: CellValues


class Mean(NamedTuple):
    """Mean of the projections of a step: rows of the projections in the file, time of their middle, line integrals, and
    weights."""

    rows: tuple[int, int]
    time: float
    depth: CellValues
    weight: CellValues


@dataclass(frozen=True, eq=False)
class Octave:
    """The steps of an octave; each is the mean of `views` projections.

    Attributes:
        waiting: projections of the step that is not complete yet.
        means: means of the last two steps, the older one first.
        steps: the last MEMORY steps that have both neighbours, the newest one first.
        n: number of steps so far.
        usual: float32 [row, col], usual square of the change; None before the first step.
    """

    views: int
    waiting: tuple[Mean, ...] = ()
    means: tuple[Mean, ...] = ()
    steps: tuple[OctaveStep, ...] = ()
    n: int = 0
    usual: CellValues | None = None


class SampleMotion(NamedTuple):
    """Motion of the sample: rotation in radians per projection, possible columns of the axis, largest radius in
    cells."""

    turn: float
    axes: tuple[float, ...]
    radius: float


class Track(NamedTuple):
    """A path through the field of view that ends in one of the newest steps of an octave.

    Attributes:
        score: sum of the changes along the path, in standard deviations of that sum.
        rival: the largest score that a point of the sample reaches in the same projections.
        uneven: mean square deviation of the changes from their mean, in units of noise plus a fraction of the mean.
        row: row of cells.
        cols: column in each step, the newest step first.
        steps: steps of the track, the newest one first.
    """

    score: float
    rival: float
    uneven: float
    row: int
    cols: NDArray[np.float64]
    steps: tuple[OctaveStep, ...]

    @property
    def speed(self) -> float:
        """Mean speed in cells per projection."""
        return float((self.cols[0] - self.cols[-1]) / (self.steps[0].time - self.steps[-1].time))


def with_view(octave: Octave, row: int, time: float, depth: CellValues, weight: CellValues) -> Octave:
    """The octave with the next projection added. `row` is the row of this projection in the file."""
    waiting = (*octave.waiting, Mean((row, row), time, depth, weight))
    if len(waiting) < octave.views:
        return replace(octave, waiting=waiting)
    if octave.views == 1:
        mean = waiting[0]
    else:
        mean = Mean(
            (waiting[0].rows[0], row),
            0.5 * (waiting[0].time + time),
            np.mean(np.stack([view.depth for view in waiting]), axis=0),
            np.mean(np.stack([view.weight for view in waiting]), axis=0),
        )
    if len(octave.means) < 2:
        return replace(octave, waiting=(), means=(*octave.means, mean))
    before, own = octave.means
    change, least = _change(before.depth, own.depth, mean.depth, own.weight)
    noise, usual = _noise(change, own.weight, least, octave.usual, max(FORGET, 1 / (octave.n + 1)))
    steps = (OctaveStep(own.rows, own.time, change, noise), *octave.steps)[:MEMORY]
    return Octave(octave.views, (), (own, mean), steps, octave.n + 1, usual)


def _change(before: CellValues, own: CellValues, after: CellValues, weight: CellValues) -> tuple[CellValues, float]:
    """The difference between a step and its neighbours, and the standard deviation of its noise in a cell of weight 1.
    Changes that whole rows or columns have in common are subtracted from the difference, and the difference is
    smoothed.
    """
    exposed, root, apart = weight > LIT, np.sqrt(weight), before - after
    change = (own - 0.5 * (before + after)) * exposed
    sample = (change * root).ravel()[::SAMPLED][exposed.ravel()[::SAMPLED]]
    noise = max(median_deviation(sample) if sample.size else 1.0, LEAST_NOISE)
    # If one neighbour is much brighter than the other, only the darker one is used.
    change -= 0.5 * np.abs(apart) * (apart * apart * weight > (SPIKE * noise) ** 2) * exposed
    for axis in (0, 1):
        if change.shape[axis] >= COMMON:
            common = (np.clip(change * root, -OUTLIER * noise, OUTLIER * noise) * root).sum(axis, keepdims=True)
            change -= common / (weight.sum(axis, keepdims=True) + LIT) * exposed
    change = scipy.ndimage.correlate1d(change, KERNEL, axis=1, mode="constant")
    if len(change) >= KERNEL_ROWS.size:
        change = scipy.ndimage.correlate1d(change, KERNEL_ROWS, axis=0, mode="constant")
    return change, noise


def _noise(
    change: CellValues, weight: CellValues, noise: float, usual: CellValues | None, newest: float
) -> tuple[CellValues, CellValues]:
    """Standard deviation of the change in each cell, and the usual square of the change after this projection. Both are
    larger at the edges of the sample and next to these edges.
    """
    least = np.float32(noise**2) / np.maximum(weight, np.float32(LIT))
    if usual is None:
        usual = np.maximum(scipy.ndimage.uniform_filter(change**2, 5, mode="nearest"), least)
    else:
        usual = usual + np.float32(newest) * (np.minimum(change**2, OUTLIER**2 * usual) - usual)
    high = np.maximum(usual, scipy.ndimage.uniform_filter1d(usual, 3, axis=0, mode="nearest"))
    high = scipy.ndimage.maximum_filter1d(high, 3, axis=1, mode="nearest")
    return np.sqrt(np.maximum(high, 0.25 * least)), usual


def tracks_of(octave: Octave, sample: SampleMotion, least: float) -> list[Track]:
    """Tracks through the newest step with a score above `least`, the highest first."""
    if len(octave.steps) < SEED:
        return []
    newest = np.stack([step.change / step.noise for step in octave.steps[:SEED]])
    rows, cols = newest.shape[1:]
    fastest = SLOW if octave.views > 1 else max(cols / SEED, SLOW)
    speeds = np.arange(SLOWEST, fastest + APART, APART)
    speeds = np.concatenate([speeds, -speeds])
    offsets = np.rint(speeds[:, None] * np.arange(SEED)).astype(np.int64)
    best = np.empty((rows, cols), np.float32)
    newest = np.minimum(newest, np.float32(CLIP))
    _highest(newest, offsets, best)
    tracks = [
        _track(octave, row, float(col), speeds[_fastest(newest[:, row], offsets, col)] / octave.views, sample, least)
        for row, col in _seeds(best)
    ]
    return sorted((track for track in tracks if track is not None), key=lambda track: -track.score)


def _seeds(best: CellValues) -> list[tuple[int, int]]:
    """Row and column of the highest local maxima of the sums over SEED steps, the highest first."""
    rows, cols = np.divmod(np.flatnonzero(best > 2 * PROMISING), best.shape[1])
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(best, ((1, 1), (2, 2))), (3, 5))
    peak = best[rows, cols] >= windows[rows, cols].max(axis=(1, 2), initial=0)
    order = np.argsort(-best[rows, cols][peak], kind="stable")[:MOST_SEEDS]
    return list(zip(rows[peak][order].tolist(), cols[peak][order].tolist(), strict=True))


def _fastest(steps: CellValues, offsets: NDArray[np.int64], col: int) -> int:
    """Speed of the line that ends in this column and has the largest sum; lines are [speed, step], steps [step,
    col]."""
    places = col - offsets
    inside = (places[:, -1] >= 0) & (places[:, -1] < steps.shape[1])
    sums = steps[np.arange(SEED), places.clip(0, steps.shape[1] - 1)].sum(axis=1)
    return int(np.where(inside, sums, -np.inf).argmax())


def _track(octave: Octave, row: int, col: float, speed: float, sample: SampleMotion, least: float) -> Track | None:
    """The best track through a seed; None if its score is at most `least`."""
    times = np.array([octave.steps[0].time - step.time for step in octave.steps])
    change = np.stack([step.change[row] for step in octave.steps])
    noise = np.stack([step.noise[row] for step in octave.steps])
    middle = sum(sample.axes) / len(sample.axes)
    fits = []
    for turn in (0.0, sample.turn):  # a straight line, or a point that rotates with the stage far from the axis
        fit = np.zeros(4)
        _grow(change, noise, times, (col, speed), (turn, middle), fit)
        fits.append((*fit.tolist(), turn))
    score, x, v, n, turn = max(fits)
    if score <= least:
        return None
    cols = np.array([_place(x, v, time, turn, middle) for time in times[: int(n)]])
    rows = slice(_ended(change, noise, cols), int(n))
    part = change[rows], noise[rows], times[rows]
    rival = max(_rival(*part, float(cols[rows][0]), sample.turn, axis, sample.radius) for axis in sample.axes)
    return Track(score, rival, _uneven(*part[:2], cols[rows]), row, cols[rows], octave.steps[rows])


def _ended(change: CellValues, noise: CellValues, cols: NDArray[np.float64]) -> int:
    """Number of newest steps to leave out for the largest score, because the particle has left the field of view.
    More than
    SEED steps remain."""
    places = np.arange(cols.size), np.clip(np.floor(cols + 0.5).astype(int), 0, change.shape[1] - 1)
    weight = noise[places].astype(float) ** -2
    evidence = np.minimum(change[places] / noise[places], CLIP) * np.sqrt(weight)
    scores = evidence[::-1].cumsum()[::-1] / np.sqrt(weight[::-1].cumsum()[::-1])
    return int(np.argmax(scores[: max(cols.size - SEED, 1)]))


def _uneven(change: CellValues, noise: CellValues, cols: NDArray[np.float64]) -> float:
    """Mean square deviation of the changes along a track from their mean, divided by the value expected from noise and
    UNEVEN."""
    places = np.arange(cols.size), np.clip(np.floor(cols + 0.5).astype(int), 0, change.shape[1] - 1)
    depth, weight = change[places].astype(float), noise[places].astype(float) ** -2
    mean = float((depth * weight).sum() / weight.sum())
    return float(np.mean((depth - mean) ** 2 / (1 / weight + (UNEVEN * mean) ** 2)))


@njit(nogil=True, cache=True, fastmath={"contract", "reassoc", "nnan", "nsz"})
def _highest(steps, offsets, best):
    """Fills `best` with the largest sum of four steps along the lines that end at each cell."""
    _, rows, cols = steps.shape
    for row in range(rows):
        best[row] = 0
        for k in range(offsets.shape[0]):
            low, high = max(0, offsets[k, 3]), min(cols, cols + offsets[k, 3])
            line, first = best[row, low:high], steps[0, row, low:high]
            two = steps[1, row, low - offsets[k, 1] : high - offsets[k, 1]]
            three = steps[2, row, low - offsets[k, 2] : high - offsets[k, 2]]
            four = steps[3, row, low - offsets[k, 3] : high - offsets[k, 3]]
            for i in range(high - low):
                line[i] = max(line[i], (first[i] + two[i]) + (three[i] + four[i]))


@njit(nogil=True, cache=True)
def _place(x, v, time, turn, axis):
    """Column of a point, `time` projections before it was at x with the speed v per projection. If `turn` is 0, the
    point moves on a straight line."""
    if turn == 0.0:
        return x - v * time
    return axis + (x - axis) * np.cos(turn * time) - v / turn * np.sin(turn * time)


@njit(nogil=True, cache=True)
def _longest(change, noise, times, x, v, motion, most):
    """Score and number of steps of the best part of a track, among all parts that begin with its newest step."""
    total, weight, best, steps = 0.0, 0.0, 0.0, 0
    cols = change.shape[1]
    for k in range(most):
        c = int(np.floor(_place(x, v, times[k], motion[0], motion[1]) + 0.5))
        if c < 0 or c >= cols:
            break
        s = noise[k, c]
        total += min(change[k, c] / s, CLIP) / s
        weight += 1 / (s * s)
        score = total / np.sqrt(weight)
        if k >= SEED and score > best:
            best, steps = score, k + 1
    return best, steps


@njit(nogil=True, cache=True)
def _grow(change, noise, times, seed, motion, fit):
    """Fills `fit` with the score, position, speed and number of steps of the track that is extended from a seed."""
    x, v = seed
    most = min(SEED + 2, times.size)
    while True:
        span = times[most - 1]
        for _ in range(2):
            from_x, from_v, best = x, v, -1.0
            for i in range(-2, 3):
                for j in range(-3, 4):
                    new_x, new_v = from_x + FINE * i, from_v + 1.5 * FINE * j / span
                    score, steps = _longest(change, noise, times, new_x, new_v, motion, most)
                    if score > best:
                        best, x, v = score, new_x, new_v
                        fit[0], fit[1], fit[2], fit[3] = score, x, v, steps
        if most == times.size:
            break
        most = min(int(most * LONGER), times.size)


@njit(nogil=True, cache=True)
def _rival(change, noise, times, newest, turn, axis, radius):
    """The largest score, in these steps, of a point that rotates within the radius of the sample and ends near
    `newest`."""
    cols, best = change.shape[1], 0.0
    span = times[-1] - times[0]
    for i in range(int(2 * REACH / FINE) + 1):
        x = newest - REACH + FINE * i
        room = radius * radius - (x - axis) * (x - axis)
        if room < 0:
            continue
        fastest = min(turn * np.sqrt(room), float(cols))
        n = int(fastest * span / FINE) + 1
        for j in range(-n, n + 1):
            total, weight = 0.0, 0.0
            for k in range(times.size):
                c = int(np.floor(_place(x, fastest * j / n, times[k] - times[0], turn, axis) + 0.5))
                if c >= 0 and c < cols:
                    s = noise[k, c]
                    total += min(change[k, c] / s, CLIP) / s
                    weight += 1 / (s * s)
            # While the point is outside the field of view, it does not affect the intensity.
            if weight > 0 and total > 0:
                best = max(best, total / np.sqrt(weight))
    return best
