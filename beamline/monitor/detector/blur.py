"""Check `blur`: loss of fine detail because of defocus or motion during the exposure.

Sharpness is the contrast of second differences over two pixels, divided by the contrast of first differences over four
pixels, along the rows and along the columns. Sharpness is 1 for a sharp edge, smaller for a blurred edge, and 0 for a
slope. Contrast is the mean product of a difference and the same difference in the next line. Noise is independent from
line to line, so it adds nothing on average, even with few photons; an edge continues in the next line. The intensity
and smooth variations of the beam cancel.

Once per scan, the check also looks for phase fringes: the rims of edges are then brighter than the open beam, which
blur cannot cause.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from beamline.monitor.change import FrameScatter, running_mean
from beamline.monitor.check import CheckResult, Flag, Level, Logged, ScanContext, again_by
from beamline.monitor.digest import FrameDigest
from beamline.monitor.view import CellValues
from drivers.base.frame import Frame, FrameKind
from recon.base.setting import setting
from recon.prep.overshoot import LEAST_SHARE, SEARCH, Overshoot

PIXELS = 2**16  # approximate number of rows of a frame that are used
STRIP = 6  # number of neighbouring rows that are used together
FAR = 4  # number of pixels that a difference spans; even
STEEPEST = 0.5  # share of the open beam: a larger difference is a zinger or a hot pixel
SIGMAS = 8.0
LEAST = 0.9  # highest useful limit; if the limit is higher, there are too few photons or edges
GONE = 0.5  # the sharpness is normal again if the loss is below this share of the limit
PATIENCE = 40  # number of projections after which the loss is the new normal
VIEWS_FOR_EDGES = 32  # number of projections whose outer edges are examined
DARKEST = 0.05  # share of the flat's mean: pixels with less intensity are not used


@dataclass(frozen=True, eq=False)
class BlurState:
    # kind, counted: kind and number of the frames of the latest group
    kind: FrameKind = FrameKind.INVALID
    counted: int = 0
    # dark, flat: float32 [line, col], means of the latest groups on the lines that are used; None if there are none yet
    dark: CellValues | None = None
    flat: CellValues | None = None
    # across, down: the usual sharpness along the rows and along the columns
    across: FrameScatter = field(default_factory=FrameScatter)
    down: FrameScatter = field(default_factory=FrameScatter)
    # the same for the first projections; these values do not change
    first: tuple[FrameScatter, FrameScatter] | None = None
    blurred: int = 0  # number of successive projections that are flagged
    reported: bool = False  # True if the slow loss was reported
    views: tuple[CellValues, ...] | None = ()  # the first projections as counts; None: their edges were examined


@dataclass(frozen=True)
class BlurCheck(Logged):
    """Score: fraction of fine contrast that a projection has lost relative to the projections before.

    Reason for the default: a blur of 0.7 pixels (sigma) removes 0.3 of the fine contrast of round particles, and 0.4 of
    that of flat faces. A slow loss is reported as info, and only if both directions have it, because a sample with flat
    faces also loses sharp edges by rotation. Phase fringes are reported as info, too. Their score is the depth of the
    line integrals next to an outer edge below the air, as a fraction of the step at the edge.
    """

    name: ClassVar[str] = "blur"
    bit: ClassVar[int] = 14
    unit: ClassVar[str] = "fraction of the fine contrast"
    meaning: ClassVar[str] = "the projection is less sharp than the projections before"

    warn: float = setting(0.3, "largest allowed loss of fine contrast, as a fraction", ge=0, lt=1)

    start = BlurState

    def look(self, state: BlurState, frame: Frame, digest: FrameDigest, context: ScanContext) -> CheckResult[BlurState]:
        looked = self._loss_of(state, frame, context)
        after = looked.state
        if context.view is None or looked.flag is not None or after.flat is None or after.views is None:
            return looked
        dark = 0.0 if after.dark is None else after.dark
        views = (*after.views, _lines(frame).astype(np.float32))
        if len(views) < VIEWS_FOR_EDGES:
            return CheckResult(replace(after, views=views))
        overshoot, after = Overshoot.of_counts(np.stack(views), dark, after.flat), replace(after, views=None)
        if not overshoot.certain:
            return CheckResult(after)
        advice = f"{overshoot.in_words()} {SEARCH}"
        return CheckResult(after, Flag(self.name, Level.INFO, frame.index, overshoot.share, LEAST_SHARE, advice))

    def _loss_of(self, state: BlurState, frame: Frame, context: ScanContext) -> CheckResult[BlurState]:
        """The loss of sharpness of the frame, relative to the projections before."""
        if frame.kind is not FrameKind.PROJECTION:
            return CheckResult(_with_reference(state, frame))
        if context.view is None:
            return CheckResult(state)
        if not context.follows:  # a sample may be less sharp when seen from that side
            state = replace(state, across=FrameScatter(), down=FrameScatter(), blurred=0)
        across, down = sharpness(_lines(frame), state.dark, state.flat)
        after = replace(state, kind=frame.kind, across=_updated(state.across, across), down=_updated(state.down, down))
        if not after.across.ready:
            return CheckResult(after)
        if state.first is None:
            return CheckResult(replace(after, first=(after.across, after.down)))
        losses = [_loss(now, usual) for now, usual in ((across, state.across), (down, state.down))]
        limits = [self._limit(usual) for usual in (state.across, state.down)]
        least = GONE if state.blurred else 1.0
        over = [loss > least * limit and limit < LEAST for loss, limit in zip(losses, limits, strict=True)]
        if not any(over) or state.blurred >= PATIENCE:
            return self._slow(replace(after, blurred=0), frame.index)
        after = replace(state, kind=frame.kind, blurred=state.blurred + 1)
        worst = int(np.argmax(np.where(over, losses, -np.inf)))
        where = "" if all(over) else (" along the rows", " along the columns")[worst]
        worst_loss = losses[worst]
        advice = (
            f"Check focus and vibration: fine details have {worst_loss:.0%} less contrast{where} than in the "
            "projections before. The focus moved, or the sample moved during the exposure. " + again_by(self.name)
        )
        return CheckResult(after, Flag(self.name, Level.WARN, frame.index, losses[worst], limits[worst], advice))

    def _limit(self, usual: FrameScatter) -> float:
        return max(self.warn, SIGMAS * usual.sigma / usual.mean) if usual.mean > 0 else 1.0

    def _slow(self, state: BlurState, row: int) -> CheckResult[BlurState]:
        """Information that is given once: both directions are less sharp than in the first projections."""
        assert state.first is not None
        losses = [_loss(now.mean, first) for now, first in zip((state.across, state.down), state.first, strict=True)]
        limit = max(self._limit(first) for first in state.first)
        if state.reported or limit >= LEAST or min(losses) <= limit:
            return CheckResult(state)
        advice = (
            f"Compare with the opposite projection (180° away): fine details have {min(losses):.0%} less contrast than "
            "in the first projections. Either the focus drifts, or the sample has no sharp edges in this direction."
        )
        return CheckResult(replace(state, reported=True), Flag(self.name, Level.INFO, row, min(losses), limit, advice))


def sharpness(lines: NDArray[Any], dark: CellValues | None, flat: CellValues | None) -> tuple[float, float]:
    """Ratio of fine to coarse contrast, along rows and along columns; NaN if there is no contrast.

    Args:
        lines: counts [line, col] of strips of `STRIP` neighbouring rows.
        dark, flat: the same lines of the mean dark and the mean flat.
    """
    low = np.zeros_like(lines, np.float32) if dark is None else dark
    if flat is None:
        scale = np.full_like(low, 1 / max(float(lines.mean(dtype=np.float64)), 1e-9))
    else:
        intensity = flat - low
        exposed = intensity > DARKEST * max(float(intensity.mean()), 0.0)
        scale = np.divide(1, intensity, out=np.zeros_like(intensity), where=exposed)
    strip = min(STRIP, len(lines))
    shape, used = (-1, strip, lines.shape[1]), len(lines) // strip * strip
    scaled, exposed = ((lines - low) * scale)[:used].reshape(shape), (scale > 0)[:used].reshape(shape)
    return _ratio(scaled, exposed), _ratio(scaled.swapaxes(1, 2), exposed.swapaxes(1, 2))


def _lines(frame: Frame) -> NDArray[Any]:
    """The rows that are used: all rows of a small frame, or strips of STRIP rows of a large frame."""
    counts = frame.counts if frame.counts.dtype == np.uint16 else frame.counts.astype(np.float32)
    rows, cols = counts.shape
    strips = max(1, min(rows // STRIP, PIXELS // (STRIP * cols)))
    if rows <= STRIP:
        return counts
    starts = np.linspace(0, rows - STRIP, strips).astype(int)
    return counts[(starts[:, None] + np.arange(STRIP)).ravel()]


def _with_reference(state: BlurState, frame: Frame) -> BlurState:
    counted = state.counted + 1 if frame.kind is state.kind else 1
    state = replace(state, kind=frame.kind, counted=counted)
    lines = _lines(frame).astype(np.float32)
    if frame.kind is FrameKind.DARK:
        return replace(state, dark=running_mean(state.dark, lines, counted))
    if frame.kind is FrameKind.FLAT:
        return replace(state, flat=running_mean(state.flat, lines, counted))
    return state


def _updated(usual: FrameScatter, figure: float) -> FrameScatter:
    if not math.isfinite(figure):
        return usual
    return usual.with_figure(figure) if usual.n else FrameScatter(1, figure)


def _loss(now: float, usual: FrameScatter) -> float:
    return 1 - now / usual.mean if usual.mean > 0 else 0.0


def _ratio(intensity: CellValues, exposed: NDArray[np.bool_]) -> float:
    """Contrast of second differences along the last axis, divided by that of first differences; NaN if there is no
    contrast."""
    n = max(intensity.shape[-1] - FAR, 0)
    first, middle, last = (intensity[..., i : i + n] for i in (0, FAR // 2, FAR))
    known = exposed[..., :-FAR] & exposed[..., FAR // 2 : -FAR // 2] & exposed[..., FAR:]
    steps = (known * np.clip(each, -STEEPEST, STEEPEST) for each in (first - 2 * middle + last, last - first))
    near, far = (float(np.vdot(step[:, 1:], step[:, :-1])) for step in steps)
    return near / far if far > 0 else math.nan
