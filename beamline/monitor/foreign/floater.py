"""Check `floater`: a loose particle that crosses the field of view on a path that no point of the sample takes.

The track of a particle is found from the sum over all projections that show it (`track`). The track is compared with
the paths of points of the sample, which are sine curves about the axis, within the radius of the sample. A particle
absorbs the same in every projection. Edges and textures of the sample may lie on a line by chance, but their absorption
varies.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from beamline.core.flag import PixelBox
from beamline.monitor.change import MOST_STEPS
from beamline.monitor.check import CheckResult, Flag, Level, Logged, ScanContext
from beamline.monitor.digest import FrameDigest
from beamline.monitor.foreign.track import Octave, SampleMotion, Track, tracks_of, with_view
from beamline.monitor.view import CellGrid
from drivers.base.frame import Frame
from recon.base.setting import setting

OCTAVES = 4  # steps of 1, 2, 4 and 8 projections
# largest number of cells per step that the rim may move; with more, the sample changes completely from step to step
FASTEST_RIM = 4.0
# tolerance in steps: the next projection comes a whole number of steps, up to MOST_STEPS, after the last one
EVEN = 0.5
COARSEST = math.radians(20)  # largest step per projection; a larger motion cannot be followed
WIDER = 2.2  # largest width of a truncated sample, as a multiple of the width of the field of view
MARGIN = 1.1  # the sample may be slightly wider than the field of view
# the same for a cone beam; nearer to the source the sample moves faster, by a factor of 1.3 for half a cone angle of 15
# degrees
CONE = 1.4
OFF_MIDDLE = 0.05  # range of the axis, as a share of the field of view, if the axis is not stated
# smallest difference of the squares of score and rival: 6 standard deviations, more than a search finds in noise
UNLIKELY = 36.0
# largest share of the score: both scores grow with the depth, and so does the part that either of them misses
RIVAL = 0.85
UNEVEN = 2.5  # largest mean square deviation from a constant depth; it is 1 for noise, and up to 2 in a few steps
NEAR = 3.0  # largest distance in cells between two tracks of the same particle
BOX = 3.0  # distance in cells from the middle of a particle to the edges of its region
HALF = 0.5  # share of the depth above which a row belongs to the particle
HIGHEST = 8  # number of cells above and below the track in which the rows of the particle are searched


@dataclass(frozen=True, eq=False)
class SeenCrumb:
    """A particle that was detected, with its track.

    Attributes:
        first, last: rows in the file of the projections that show it so far.
        time, col, speed: time (in projections) and column (in cells) at which it was seen last, and its speed in
            cells per projection.
        top, below: its first row and the row after its last, in cells.
    """

    first: int
    last: int
    time: float
    col: float
    speed: float
    top: int
    below: int


@dataclass(frozen=True, eq=False)
class FloaterState:
    """The projections since the last gap: time of the last one (in projections), angles of the first and the last one,
    and their step in rad."""

    octaves: tuple[Octave, ...] = ()
    time: float = 0.0
    start: float = math.nan
    angle: float = math.nan
    step: float = math.nan
    crumbs: tuple[SeenCrumb, ...] = ()


@dataclass(frozen=True)
class FloaterCheck(Logged):
    """Score: sum of the absorption along the track, in standard deviations."""

    name: ClassVar[str] = "floater"
    bit: ClassVar[int] = 10
    unit: ClassVar[str] = "standard deviations"
    meaning: ClassVar[str] = (
        "a loose particle crosses the field of view, on a path that no point of the rotating sample takes"
    )

    warn: float = setting(
        7.0,
        "the check warns if the absorption of a particle, added up along its path, exceeds this number of standard "
        "deviations",
        ge=0,
    )

    start = FloaterState

    def look(
        self, state: FloaterState, frame: Frame, digest: FrameDigest, context: ScanContext
    ) -> CheckResult[FloaterState]:
        view, grid = context.view, context.grid
        if view is None or grid is None:
            return CheckResult(state)
        state = _after(state, view.angle, context.follows)
        if not state.step < COARSEST:
            return CheckResult(state)
        half = grid.shape[1] / 2
        octaves, tracks = [], list[Track]()
        for before in state.octaves:
            octave = before
            if octave.views == 1 or half * state.step * octave.views <= FASTEST_RIM:
                octave = with_view(before, view.index, state.time, view.depth, view.weight)
                if octave.n > before.n:
                    tracks += tracks_of(octave, _sample(grid, context, state.step), self.warn)
            octaves.append(octave)
        state = replace(state, octaves=tuple(octaves))
        sure = [track for track in tracks if _is_crumb(track)]
        return self._flagged(state, max(sure, key=lambda track: track.score), grid) if sure else CheckResult(state)

    def _flagged(self, state: FloaterState, track: Track, grid: CellGrid) -> CheckResult[FloaterState]:
        """The flag for the projections that show the particle and came after the last flag for it."""
        newest, oldest = track.steps[0], track.steps[-1]
        top, below = _rows(track)
        crumb = SeenCrumb(oldest.rows[0], newest.rows[1], newest.time, float(track.cols[0]), track.speed, top, below)
        known = [each for each in state.crumbs if _same(each, crumb)]
        others = tuple(each for each in state.crumbs if each not in known and crumb.last - each.last <= grid.shape[1])
        after = replace(state, crumbs=(*others, crumb))
        if known:
            first = min(each.first for each in known)
            after = replace(after, crumbs=(*others, replace(crumb, first=min(first, crumb.first))))
        begin = max([crumb.first, *(each.last + 1 for each in known if crumb.first >= each.first)])
        if begin > crumb.last:
            return CheckResult(after)
        span = max(newest.time - oldest.time, 1.0)
        share = (crumb.last - begin) / max(crumb.last - crumb.first, 1)
        where = [_region(grid, crumb, col) for col in (crumb.col, crumb.col - track.speed * span * share)]
        cell = grid.cell
        first_row, last_row = top * cell, below * cell - 1
        first_frame, last_frame = after.crumbs[-1].first, crumb.last
        speed, side = abs(track.speed) * cell, "right" if track.speed > 0 else "left"
        advice = (
            f"Find the particle and blow it off: it crosses the field of view in rows {first_row} ... {last_row}, in "
            f"frames {first_frame} ... {last_frame} so far, and moves {speed:.1f} px per projection to the {side}. "
            "No point of the rotating sample moves like this, so the particle is falling, floating or sitting on "
            "the holder. `beamline recon` gives rays through the particle less weight; repeat the scan if streaks "
            "remain."
        )
        flag = Flag(self.name, Level.WARN, crumb.last, track.score, self.warn, advice, where[0], begin, where[1])
        return CheckResult(after, flag)


def _after(state: FloaterState, angle: float, follows: bool) -> FloaterState:
    """The state for the next projection. If it is not a neighbour of the last projection, or if steps are uneven,
    tracks start again."""
    steps = 1.0
    if state.time > 0 and state.step != 0:
        steps = (angle - state.angle) / math.copysign(state.step, state.angle - state.start)
    elif state.time > 0:
        steps = 1.0 if angle == state.angle else math.nan
    if not state.octaves or not follows or not EVEN < steps < MOST_STEPS + EVEN:
        return FloaterState(tuple(Octave(2**i) for i in range(OCTAVES)), 0.0, angle, angle)
    time = state.time + max(round(steps), 1)
    return replace(state, time=time, angle=angle, step=abs(angle - state.start) / time)


def _sample(grid: CellGrid, context: ScanContext, step: float) -> SampleMotion:
    cols = grid.shape[1]
    if context.axis_col is None:
        middle = (cols - 1) / 2
        axes: tuple[float, ...] = (middle - OFF_MIDDLE * cols, middle, middle + OFF_MIDDLE * cols)
    else:
        axes = ((context.axis_col + 0.5) / grid.cell - 0.5,)
    wide = WIDER if context.truncated else CONE if context.cone else MARGIN
    return SampleMotion(step, axes, cols / 2 * wide)


def _is_crumb(track: Track) -> bool:
    unlike = track.score**2 - track.rival**2 >= UNLIKELY and track.rival <= RIVAL * track.score
    return unlike and track.uneven <= UNEVEN


def _same(known: SeenCrumb, crumb: SeenCrumb) -> bool:
    """Whether a track continues the known track."""
    distance = abs(known.col + known.speed * (crumb.time - known.time) - crumb.col)
    rows = known.top - 1 <= crumb.below and crumb.top - 1 <= known.below
    return rows and distance <= NEAR + 0.2 * abs(known.speed * (crumb.time - known.time))


def _rows(track: Track) -> tuple[int, int]:
    """First row of cells of the particle, and the row after the last one."""
    rows, cols = track.steps[0].change.shape
    track_cols = np.clip(np.floor(track.cols + 0.5).astype(int), 0, cols - 1)
    depth = np.mean([step.change[:, col] for step, col in zip(track.steps, track_cols, strict=True)], axis=0)
    deep = depth > HALF * depth[track.row]
    top = below = track.row
    while top > max(0, track.row - HIGHEST) and deep[top - 1]:
        top -= 1
    while below < min(rows, track.row + HIGHEST) and deep[below]:
        below += 1
    return top, max(below, top + 1)


def _region(grid: CellGrid, crumb: SeenCrumb, col: float) -> PixelBox:
    height = crumb.below - crumb.top + 2
    return grid.region((crumb.top + crumb.below - 1) / 2, col, height, 2 * BOX)
