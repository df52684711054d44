"""Checks `field`, `mass`, `pixels`: areas without beam, a sample larger than the field of view, total absorption, dead
pixels.

In a parallel beam the total absorption is the same in every projection, unless material entered or left the field of
view. This is the moment of order 0 of the consistency conditions of Helgason (1965) and Ludwig (1966).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import scipy
from numpy.typing import NDArray

from beamline.monitor.check import CheckResult, Flag, Level, Logged, ScanContext, at_edges, intensity
from beamline.monitor.digest import LARGEST, FrameDigest
from beamline.monitor.view import AIR, BRIGHT, UNLIT, CellGrid, brightest_place
from drivers.base.frame import Frame, FrameKind
from recon.base.arrays import median_deviation
from recon.base.noise import deviation_between_neighbours
from recon.base.reach import LEAST
from recon.base.setting import setting

LASTS = 5  # number of successive projections with sample at an edge
NO_BEAM = 3.0  # factor on the noise; a flat whose bright part is below it has no beam (noise alone gives 1.3)
NAMED = 4  # largest number of shadows that the advice names


@dataclass(frozen=True)
class FieldState:
    """State.

    Attributes:
        unlit: True if flats without beam were reported.
        inside: True if the whole sample was in the field of view in some projection.
        cut: number of consecutive projections with sample at the edges.
        reported: True if the sample at the edges was reported.
    """

    unlit: bool = False
    inside: bool = False
    cut: int = 0
    reported: bool = False


@dataclass(frozen=True)
class FieldOfViewCheck(Logged):
    """Score in a flat: fraction of the frame without beam. Score in a projection: line integral at the edge of the
    field of view (a flag of the level info, at most one in a scan).

    Reasons for the defaults: a line integral of 0.1 at the edges is a tenth of the value in the middle of a sample.
    Phase fringes and scattered radiation cause less there. Slits usually shadow one or two lines at the edges of the
    frame.
    """

    name: ClassVar[str] = "field"
    bit: ClassVar[int] = 13
    unit: ClassVar[str] = (
        "fraction of the pixels that get no beam (flats), or line integral at the edge of the field of view "
        "(projections)"
    )
    meaning: ClassVar[str] = "a part of the frame gets no beam even without a sample"

    unlit: float = setting(
        0.02, "the check warns if more than this fraction of the pixels of a flat gets no beam", ge=0, lt=1
    )
    edge: float = setting(LEAST, "line integral at the edges up to which the sample counts as inside", ge=0)

    start = FieldState

    def look(
        self, state: FieldState, frame: Frame, digest: FrameDigest, context: ScanContext
    ) -> CheckResult[FieldState]:
        if frame.kind is FrameKind.FLAT and context.dark is not None:
            if state.unlit:
                return CheckResult(state)
            flag = self._unlit(frame, digest.preview - context.dark)
            return CheckResult(replace(state, unlit=flag is not None), flag)
        if context.view is None or context.grid is None or not context.grid.flats or state.reported:
            return CheckResult(state)
        edges = at_edges(context)
        cut = state.cut + 1 if max(edges) > self.edge else 0
        if cut < LASTS:
            return CheckResult(replace(state, cut=cut, inside=state.inside or cut == 0))
        return CheckResult(replace(state, reported=True), self._cut(frame.index, edges, context.grid, state.inside))

    def _unlit(self, frame: Frame, intensity: NDArray[np.float32]) -> Flag | None:
        bright = float(np.percentile(intensity[::2, ::2], BRIGHT))
        rows, cols = frame.counts.shape
        if bright <= NO_BEAM * deviation_between_neighbours(intensity[::2]):
            advice = "Check that the beam is on and the shutter is open: this flat is as dark as the darks."
            return Flag(self.name, Level.WARN, frame.index, 1.0, self.unlit, advice, (0, rows, 0, cols))
        unlit = intensity < UNLIT * bright
        share = float(unlit.mean())
        if share <= self.unlit:
            return None
        step = frame.counts.shape[0] / intensity.shape[0]
        strips = [
            (first, after, axis) for axis in (0, 1) for first, after in _runs(unlit.mean(axis=1 - axis) > 0.5, step)
        ]
        names = [f"{('rows', 'columns')[axis]} {first} ... {after - 1}" for first, after, axis in strips]
        named = ", ".join(names[:NAMED])
        named += f", and {len(strips) - NAMED} more" if len(strips) > NAMED else ""
        first, after, axis = max(strips, key=lambda strip: strip[1] - strip[0], default=(0, rows, 0))
        region = (first, min(after, rows), 0, cols) if axis == 0 else (0, rows, first, min(after, cols))
        advice = (
            "Open the slit or aperture that shadows the frame, or choose a smaller region of the camera: without a "
            f"sample, {share:.0%} of the frame gets no beam ({named or 'scattered pixels'})."
        )
        return Flag(self.name, Level.WARN, frame.index, share, self.unlit, advice, region)

    def _cut(self, row: int, edges: tuple[float, float], grid: CellGrid, entered: bool) -> Flag:
        left, right = edges
        cut = {side: depth for side, depth in (("left", left), ("right", right)) if depth > self.edge}
        other_side = (
            " Centre the sample on the rotation axis: in earlier projections the sample was inside the field of view."
        ) * (entered and len(cut) == 1)
        advice = (
            f"{beyond_the_field(cut)}{other_side} The sample beyond the edge has three effects: the check `mass` is "
            "switched off, slow loose particles are not detected, and reconstructions are too bright at the rim."
        )
        rows, last = grid.shape[0] * grid.cell, grid.right + 1
        first = grid.left if left >= right else max(last - 2, 0)
        region = (0, rows, first * grid.cell, (first + 2) * grid.cell)
        return Flag(self.name, Level.INFO, row, max(left, right), self.edge, advice, region)


def beyond_the_field(cut: Mapping[str, float]) -> str:
    """A sentence that names the edges ("left", "right") beyond which the sample extends, with the line integral."""
    sides = " and ".join(cut)
    largest = max(cut.values())
    return f"The sample extends beyond the {sides} edge of the field of view (line integral there: {largest:.2f})."


def _runs(marked: NDArray[np.bool_], step: float) -> list[tuple[int, int]]:
    """First pixel, and the pixel after the last one, of each unbroken run of marked lines of the preview."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], marked, [False]]).astype(np.int8)))
    return [(round(first * step), round(after * step)) for first, after in edges.reshape(-1, 2).tolist()]


CALIBRATION = 10  # number of projections
SIGMAS = 6.0
EMPTY = 1e-3  # mean line integral below which the field of view is empty


@dataclass(frozen=True)
class MassState:
    """`masses`: total absorption of the first projections. `usual`: its median; None as long as there are too few.
    `running`: number of successive outliers."""

    masses: tuple[float, ...] = ()
    usual: float | None = None
    scatter: float = 0.0
    running: int = 0


@dataclass(frozen=True)
class MassCheck(Logged):
    """Score: relative change of the mean line integral. Not applied without beam, or if the sample is larger than the
    field of view."""

    name: ClassVar[str] = "mass"
    bit: ClassVar[int] = 5
    unit: ClassVar[str] = "relative change"
    meaning: ClassVar[str] = (
        "the total absorption of several projections in a row differs from the total absorption of the first "
        "projections"
    )

    warn: float = setting(
        0.03,
        "relative change of the total absorption above which a projection counts as different from the first "
        "projections",
        ge=0,
    )
    frames: int = setting(
        3,
        "number of projections in a row, all different from the first projections, after which there is a warning",
        ge=1,
    )

    start = MassState

    def look(self, state: MassState, frame: Frame, digest: FrameDigest, context: ScanContext) -> CheckResult[MassState]:
        view, grid = context.view, context.grid
        if view is None or grid is None or not grid.flats:
            return CheckResult(state)
        if max(at_edges(context)) > AIR:
            return CheckResult(replace(state, running=0))
        exposed_share = float(grid.exposed.mean())
        if not exposed_share:
            return CheckResult(state)
        # Subtract the loss of beam intensity, so that it does not count as absorption.
        mass = float(view.depth.mean()) / exposed_share - brightest_place(view, grid)
        if state.usual is None:
            return CheckResult(_calibrate(state, mass))
        if state.usual < EMPTY:
            return CheckResult(state)
        score = mass / state.usual - 1
        limit = max(self.warn, SIGMAS * state.scatter)
        if abs(score) <= limit:
            return CheckResult(replace(state, running=0))
        state = replace(state, running=state.running + 1)
        if state.running < self.frames:
            return CheckResult(state)
        entered_or_left = "entered" if score > 0 else "left"
        advice = (
            f"Look at the latest projection: the total absorption has changed by {score:+.1%} in {state.running} "
            f"projections. Something {entered_or_left} the field of view, or the sample changes."
        )
        return CheckResult(state, Flag(self.name, Level.WARN, frame.index, score, limit, advice))


def _calibrate(state: MassState, mass: float) -> MassState:
    masses = (*state.masses, mass)
    if len(masses) < CALIBRATION:
        return replace(state, masses=masses)
    usual = float(np.median(masses))
    scatter = median_deviation(np.array(masses) - usual) / usual if usual > 0 else 0.0
    return replace(state, masses=masses, usual=usual, scatter=scatter)


DEAD = 0.2  # a pixel is dead if it is below this fraction of the intensity in the darkest preview block around it
NAMED_PIXELS = 5  # largest number of pixels that the advice names
HOLES = 1e-4  # fraction of the pixels that may have no valid value; one column of 4096 is more
HALF = 0.5  # fraction of the pixels; if more are missing, a projection is lost

PixelPlaces = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class PixelsState:
    """`dead`: positions row * columns + column of pixels that were dark in all flats of the latest group; None before
    the first flat.

    `holes`: largest fraction of pixels that are not a number in a dark or flat, because the detector masks them.
    """

    dead: PixelPlaces | None = None
    in_flats: bool = False
    reported: bool = False
    holes: float = 0.0


@dataclass(frozen=True)
class PixelsCheck(Logged):
    """Score, one of three fractions. (1) Dead pixels: they have less than a fifth of the intensity around them in all
    flats of the first group. They are reported at the first projection, as info if they are few. (2) In a projection:
    pixels that have no valid value (NaN, infinite, above LARGEST) although they have one in darks and flats. (3) In any
    frame: 1 if no pixel has a valid value.

    Reason for the default: a thousandth of the pixels is one pixel in every column of a detector with 1000 rows, and
    each makes a ring in a slice.
    """

    name: ClassVar[str] = "pixels"
    bit: ClassVar[int] = 12
    unit: ClassVar[str] = "fraction of the pixels"
    meaning: ClassVar[str] = "many pixels of the camera are dead, or have no value"

    warn: float = setting(1e-3, "fraction of dead pixels above which there is a warning", ge=0, le=1)

    start = PixelsState

    def look(
        self, state: PixelsState, frame: Frame, digest: FrameDigest, context: ScanContext
    ) -> CheckResult[PixelsState]:
        holes = digest.invalid_fraction
        if holes == 1:  # not a mask, whatever the frame shows
            return CheckResult(state, self._without_number(frame.index, holes))
        if frame.kind is not FrameKind.PROJECTION:
            state = replace(state, holes=max(state.holes, holes))
        elif holes - state.holes > HOLES:
            return CheckResult(state, self._without_number(frame.index, holes - state.holes))
        if state.reported:
            return CheckResult(state)
        if frame.kind is FrameKind.FLAT:
            dead = _dead(frame, digest, context)
            if state.in_flats and state.dead is not None:
                dead = np.intersect1d(state.dead, dead, assume_unique=True)
            return CheckResult(replace(state, dead=dead, in_flats=True))
        state = replace(state, in_flats=False)
        if frame.kind is not FrameKind.PROJECTION or state.dead is None:
            return CheckResult(state)
        return CheckResult(replace(state, reported=True), self._flag(frame, state.dead) if state.dead.size else None)

    def _without_number(self, row: int, score: float) -> Flag:
        advice = (
            f"Check the link of the camera, and the program that wrote the frames: {score:.2%} of the pixels have no "
            f"valid value (NaN, infinite or above {LARGEST:g}), more than in darks and flats. `beamline recon` fills "
            "pixels without a valid value, and does not use a projection without any valid pixel."
        )
        return Flag(self.name, Level.ALARM if score > HALF else Level.WARN, row, score, HOLES, advice)

    def _flag(self, frame: Frame, dead: PixelPlaces) -> Flag:
        rows, cols = np.unravel_index(dead, frame.counts.shape)
        score = dead.size / frame.counts.size
        level = Level.WARN if score > self.warn else Level.INFO
        named = ", ".join(f"({row}, {col})" for row, col in zip(rows[:NAMED_PIXELS], cols[:NAMED_PIXELS], strict=True))
        advice = (
            f"Dead pixels: {dead.size}, at (row, column) {named}{' ...' if dead.size > NAMED_PIXELS else ''}. These "
            "pixels are dark in the flats, although their neighbours are not. Each dead pixel would make a ring in "
            "its slice; `beamline recon` replaces dead pixels with their neighbours."
        )
        region = int(rows.min()), int(rows.max()) + 1, int(cols.min()), int(cols.max()) + 1
        return Flag(self.name, level, frame.index, score, self.warn, advice, region)


def _dead(frame: Frame, digest: FrameDigest, context: ScanContext) -> PixelPlaces:
    """Positions of the pixels of a flat that are dark in a block with beam."""
    above = intensity(digest.preview, context)
    block = math.ceil(frame.counts.shape[1] / above.shape[1])
    dark = digest.preview - above
    lowest_nearby = scipy.ndimage.minimum_filter(
        above, 3
    )  # a dark pixel at the edge of a shadow does not count as dead
    limit = np.where(
        lowest_nearby > UNLIT * np.percentile(above[::2, ::2], BRIGHT), dark + DEAD * lowest_nearby, -np.inf
    )
    counts, cols = frame.counts, frame.counts.shape[1]
    places = [
        row * block * cols + np.flatnonzero(counts[row * block : (row + 1) * block] < np.repeat(line, block)[:cols])
        for row, line in enumerate(limit.astype(np.float32))
    ]
    return np.concatenate(places)
