"""Floater: a particle that crosses the field in some views, faster than anything that turns with the sample.

It is found by filters that suppress everything that turns within the field (beamline.monitor.fan). It shows as peaks of
absorption that follow a straight line in the same rows through several views (beamline.monitor.trail). A particle of
the sample obeys col = a cos + b sin + c with sqrt(a² + b²) within the sample; a floater's line is steeper than any of
these at its place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar

import numpy as np
import scipy
from pydantic import Field

from beamline.core.jit import njit
from beamline.monitor.check import Flag, Level, Look, Policy, ScanContext
from beamline.monitor.digest import FrameDigest
from beamline.monitor.fan import Clutter, Filters, correlate, filters, window
from beamline.monitor.trail import Peaks, Rules, best_trail, no_peaks
from beamline.monitor.view import CellGrid, CellValues, CellView
from drivers.base.frame import Frame

LAGS = (-5, -4, -3, -2, -1, 0, 1, 2, 3)
LATER = LAGS[-1]  # views after the one that is judged
SPAN = LATER - LAGS[0] + 1
SIZE = 0.75  # cells: standard deviation of a ball of 6 px at 512 columns, 128 cells
SPEEDS = (1.4, 2.0, 3.0, 4.5)  # of the sample's fastest point; faster ones are in only one view of the window
STRUCTURE, COMMON = 1.0, 0.02**2  # line integrals of about 1; a beam that changes by 2 %
WIDER = 2.2  # times the field's width: how wide a sample may be that the field cuts off
MARGIN = 1.15  # the axis may be off the middle, and the sample a little wider than the field
FASTER = 1.25  # times as fast as the sample's point at the same place
RULES = Rules(span=12, least=4, share=0.4, total=30.0, rows=1.0, cols=1.0, slack=0.03)
SPIKE = 4.0  # standard deviations by which a cell may be brighter than in the views before and after: a zinger
CROWD = 12  # peaks in one view: with more the sample jumped, or it is a band
MEMORY = 0.1  # weight of the newest view in a place's usual output
VELOCITY_NOISE = 1.7  # of a change's residual over that of a view: sqrt(1 + (4/3)² + (1/3)²), see change
LEAST_NOISE = 2e-3  # line integral
LEAST_LIGHT = 1e-3  # transmission
UNEVEN = 0.2  # relative change of the angle's step for which the filters are made anew
BOX = 3.0  # cells from the middle of a floater to the edges of its region
NOISIER = (0.7, 30.0)  # noise of a cell over that of the cells that the filters are made for, at least and at most
FASTEST = 1e3  # cells a view: what moves faster is in one view only


@dataclass(frozen=True, eq=False)
class FloaterState:
    raw: tuple[CellView, ...] = ()  # the last two views
    indices: tuple[int, ...] = ()  # rows in the file of the SPAN views before the last
    # depths: their line integrals, without zingers and smoothed along the columns; oldest first
    depths: tuple[CellValues, ...] = ()
    # filters: for `step` radians a view, a sample of the radius `rim` in cells, and the noise of cells of the weight
    # `light`
    filters: Filters | None = None
    step: float = math.nan
    rim: float = math.nan
    light: float = 1.0
    # usual: usual output of the filters at each cell: the sample's sharpest edges are not suppressed completely
    usual: CellValues | None = None
    peaks: Peaks = field(default_factory=no_peaks)  # of the last views


@dataclass(frozen=True)
class FloaterCheck:
    """Score: mean of the filters' outputs along the trail, in standard deviations of what they usually give there."""

    name: ClassVar[str] = "floater"
    bit: ClassVar[int] = 10
    unit: ClassVar[str] = "standard deviations"
    meaning: ClassVar[str] = "matter crosses the field faster than the turning sample carries anything"
    policy: ClassVar[Policy] = Policy.LOG

    peak: Annotated[float, Field(ge=0, description="standard deviations of a peak that may be part of a trail")] = 4.5

    start = FloaterState

    def look(self, state: FloaterState, frame: Frame, digest: FrameDigest, context: ScanContext) -> Look[FloaterState]:
        view, change, grid = context.view, context.change, context.grid
        if view is None or grid is None:
            return Look(state)
        if change is None:  # the first views, or after a gap, or at uneven steps
            kept = state.filters, state.step, state.rim, state.light
            return Look(FloaterState((view,), (view.index,), (_smooth(view.depth),), *kept))
        noise = max(change.noise / VELOCITY_NOISE, LEAST_NOISE)
        state = _with_view(state, view, noise)
        if len(state.depths) < SPAN:
            return Look(state)
        step = abs(view.angle - state.raw[0].angle)
        rim = grid.shape[1] / 2 * (WIDER if context.truncated else 1.0)
        if state.filters is None or not abs(step / state.step - 1) < UNEVEN or rim != state.rim:
            lit = view.weight[view.weight > 0]
            light = max(float(np.median(lit)) if lit.size else 1.0, LEAST_LIGHT)
            made = _designed(rim * step, noise / math.sqrt(light))
            state = replace(state, filters=made, step=step, rim=rim, light=light, usual=None)
        assert state.filters is not None
        outputs = np.empty((len(state.filters.speeds), *grid.shape), np.float32)
        correlate(np.stack(state.depths), state.filters.weights, outputs)
        usual = np.zeros(grid.shape, np.float32) if state.usual is None else state.usual.copy()
        peaks = np.empty((CROWD + 1, 4))
        n = _peaks(
            outputs, view.weight, state.light, usual, MEMORY if state.usual is not None else 1.0, self.peak, peaks
        )
        state = replace(state, usual=usual)
        if n > CROWD:
            return Look(replace(state, peaks=no_peaks()))
        return self._linked(state, frame.index, peaks[:n], grid)

    def _linked(self, state: FloaterState, now: int, new: Peaks, grid: CellGrid) -> Look[FloaterState]:
        """Link the peaks of the view that is judged with those of the views before."""
        judged = state.indices[-1 - LATER]
        new[:, 0] = judged
        old = state.peaks[state.peaks[:, 0] >= judged - RULES.span]
        trail = best_trail(old, new, RULES, (grid.shape[1] - 1) / 2, FASTER * state.step, state.rim)
        state = replace(state, peaks=np.concatenate([old, new]))
        if trail is None:
            return Look(state)
        region = grid.region(trail.row, trail.col, 2 * BOX, 2 * BOX)
        advice = (
            f"Something crosses the field at {abs(trail.speed) * grid.cell:.1f} px a view, faster than the sample's "
            f"turning carries anything there (seen in frames {trail.first:.0f} ... {trail.last:.0f}): a floating "
            "particle in the beam or on the holder. Look for it and blow it off. `monitor.retake: "
            f"[{self.name}]` in a configuration has a scan take such views again, after the last one."
        )
        flag = Flag(self.name, Level.WARN, now, trail.score, self.peak, advice, region, int(trail.first))
        return Look(state, flag)


def _with_view(state: FloaterState, view: CellView, noise: float) -> FloaterState:
    """The state with the second newest view, without its zingers, which are in neither of its neighbours."""
    if len(state.raw) < 2:
        return replace(state, raw=(*state.raw, view))
    before, middle = state.raw
    spikeless = np.maximum(middle.depth, np.minimum(before.depth, view.depth) - np.float32(SPIKE * noise))
    return replace(
        state,
        raw=(middle, view),
        indices=(*state.indices, middle.index)[-SPAN:],
        depths=(*state.depths, _smooth(spikeless))[-SPAN:],
    )


def _designed(rim: float, noise: float) -> Filters:
    """The filters for a sample whose rim moves `rim` cells a view, and cells with this noise."""
    rim = min(rim, FASTEST)
    speeds = np.array([sign * factor * rim for factor in SPEEDS for sign in (-1, 1)] + [1e3])
    views, cols = window(LAGS)
    signals = np.exp(-0.5 * ((cols - speeds[:, None] * views) / SIZE) ** 2)
    return filters(LAGS, Clutter(MARGIN * rim, STRUCTURE, COMMON, noise**2), signals, speeds)


def _smooth(depth: CellValues) -> CellValues:
    """Matched along the columns to SIZE; white noise keeps its variance."""
    kernel = np.exp(-0.5 * (np.arange(-3, 4) / SIZE) ** 2)
    return scipy.ndimage.convolve1d(
        depth, (kernel / np.sqrt((kernel**2).sum())).astype(np.float32), axis=0, mode="constant"
    )


@njit(nogil=True, cache=True)
def _peaks(outputs, weight, light, usual, memory, least, peaks):
    """Fills `peaks` with (nothing, row, col, score) of the local maxima above `least`, until it is full: their number.

    `usual` becomes its mean with this view's, whose weight is `memory`.
    """
    signals, rows, cols = outputs.shape
    score = np.empty((rows, cols), np.float32)
    for row in range(rows):
        for col in range(cols):
            most, squares = outputs[0, row, col], np.float32(0)
            for signal in range(signals):
                y = outputs[signal, row, col]
                most = max(most, y)
                if signal < signals - 1:
                    squares += y * y
            now = np.sqrt(squares / (signals - 1))
            if memory == 1.0:
                usual[row, col] = now
            noise = np.sqrt(light / max(weight[row, col], np.float32(1e-3)))
            score[row, col] = (
                most / max(usual[row, col], min(max(noise, NOISIER[0]), NOISIER[1])) if weight[row, col] > 0 else 0.0
            )
            usual[row, col] += memory * (now - usual[row, col])
    n = 0
    for row in range(rows):
        for col in range(cols):
            own = score[row, col]
            if own <= least:
                continue
            highest = True
            for r in range(max(row - 1, 0), min(row + 2, rows)):
                for c in range(max(col - 2, 0), min(col + 3, cols)):
                    if score[r, c] > own:
                        highest = False
            if highest:
                peaks[n, 1], peaks[n, 2], peaks[n, 3] = row, col, own
                n += 1
                if n == peaks.shape[0]:
                    return n
    return n
