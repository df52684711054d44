"""Blur: loss of the finest detail, by defocus or by motion during the exposure.

The figure is the contrast of second differences over two pixels against that of first differences over four, along the
rows and along the columns: 1 for a sharp edge, less the more it is blurred, 0 for a slope. A contrast is the mean
product of a difference and the same difference a line beside it. Noise is independent from line to line and adds
nothing on average, however few the photons; edges go on. The light's level and a smooth beam cancel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar

import numpy as np
import pydantic
from numpy.typing import NDArray

from beamline.monitor.check import Flag, Level, Look, Policy, ScanContext, again_by
from beamline.monitor.digest import FrameDigest
from beamline.monitor.scatter import FrameScatter, running_mean
from beamline.monitor.view import CellValues
from drivers.base.frame import Frame, FrameKind
from recon.base.jit import njit

PIXELS = 2**16  # approximate number of rows of a frame that are used
STRIP = 6  # neighbouring rows that are used together
FAR = 4  # pixels that a difference spans; even
STEEPEST = 0.5  # share of the open beam: a larger difference is a zinger or a hot pixel
SIGMAS = 8.0
LEAST = 0.9  # highest useful limit; above it there are too few photons or edges
GONE = 0.5  # share of the limit below which sharpness is back
PATIENCE = 40  # views after which it is the new normal
DARKEST = 0.05  # share of the flat's mean: pixels with less light are not used


@dataclass(frozen=True, eq=False)
class BlurState:
    # kind, counted: of the latest group of frames
    kind: FrameKind = FrameKind.INVALID
    counted: int = 0
    # dark, flat: float32 [line, col], means of the latest groups on the lines that are looked at; None before any
    dark: CellValues | None = None
    flat: CellValues | None = None
    # across, down: the usual figures along the rows and along the columns
    across: FrameScatter = field(default_factory=FrameScatter)
    down: FrameScatter = field(default_factory=FrameScatter)
    first: tuple[FrameScatter, FrameScatter] | None = None  # the same of the first views, which stay
    blurred: int = 0  # views in a row that are flagged
    reported: bool = False  # the slow loss was reported


@dataclass(frozen=True)
class BlurCheck:
    """Score: share of its fine contrast that a view has lost against the views before.

    The default: a blur of 0.7 pixels (sigma) takes 0.3 of it from round particles and 0.4 from flat faces. A slow loss
    is a fact (info) where both directions have it: a sample with flat faces turns its sharp edges away as well.
    """

    name: ClassVar[str] = "blur"
    bit: ClassVar[int] = 14
    unit: ClassVar[str] = "share of the fine contrast"
    meaning: ClassVar[str] = "the view is less sharp than the views before"
    policy: ClassVar[Policy] = Policy.LOG

    warn: Annotated[
        float, pydantic.Field(ge=0, lt=1, description="share of the fine contrast that a view may lose")
    ] = 0.3

    start = BlurState

    def look(self, state: BlurState, frame: Frame, digest: FrameDigest, context: ScanContext) -> Look[BlurState]:
        if frame.kind is not FrameKind.PROJECTION:
            return Look(_with_reference(state, frame))
        if context.view is None:
            return Look(state)
        if not context.follows:  # a sample may be less sharp from that side
            state = replace(state, across=FrameScatter(), down=FrameScatter(), blurred=0)
        across, down = sharpness(_lines(frame), state.dark, state.flat)
        after = replace(state, kind=frame.kind, across=_updated(state.across, across), down=_updated(state.down, down))
        if not after.across.ready:
            return Look(after)
        if state.first is None:
            return Look(replace(after, first=(after.across, after.down)))
        losses = [_loss(now, usual) for now, usual in ((across, state.across), (down, state.down))]
        limits = [self._limit(usual) for usual in (state.across, state.down)]
        least = GONE if state.blurred else 1.0
        over = [loss > least * limit and limit < LEAST for loss, limit in zip(losses, limits, strict=True)]
        if not any(over) or state.blurred >= PATIENCE:
            return self._slow(replace(after, blurred=0), frame.index)
        after = replace(state, kind=frame.kind, blurred=state.blurred + 1)
        worst = int(np.argmax(np.where(over, losses, -np.inf)))
        where = "" if all(over) else (" along the rows", " along the columns")[worst]
        advice = (
            f"The finest detail has {losses[worst]:.0%} less contrast{where} than in the views before: the focus "
            "moved, or the sample moved while the frame was exposed. Check focus and vibration. " + again_by(self.name)
        )
        return Look(after, Flag(self.name, Level.WARN, frame.index, losses[worst], limits[worst], advice))

    def _limit(self, usual: FrameScatter) -> float:
        return max(self.warn, SIGMAS * usual.sigma / usual.mean) if usual.mean > 0 else 1.0

    def _slow(self, state: BlurState, row: int) -> Look[BlurState]:
        """A fact, once: both directions are less sharp than in the first views."""
        assert state.first is not None
        losses = [_loss(now.mean, first) for now, first in zip((state.across, state.down), state.first, strict=True)]
        limit = max(self._limit(first) for first in state.first)
        if state.reported or limit >= LEAST or min(losses) <= limit:
            return Look(state)
        advice = (
            f"The finest detail has {min(losses):.0%} less contrast than in the first views: the focus drifts, or the "
            "sample shows its sharp edges no more from here. Compare with the view half a turn away."
        )
        return Look(replace(state, reported=True), Flag(self.name, Level.INFO, row, min(losses), limit, advice))


def sharpness(lines: NDArray[Any], dark: CellValues | None, flat: CellValues | None) -> tuple[float, float]:
    """Ratio of fine to coarse contrast, along rows and along columns; NaN without contrast.

    Args:
        lines: counts [line, col] of strips of `STRIP` neighbouring rows; `dark` and `flat` likewise.
    """
    low = np.zeros_like(lines, np.float32) if dark is None else dark
    if flat is None:
        scale = np.full_like(low, 1 / max(float(lines.mean(dtype=np.float64)), 1e-9))
    else:
        light = flat - low
        lit = light > DARKEST * max(float(light.mean()), 0.0)
        scale = np.divide(1, light, out=np.zeros_like(light), where=lit)
    sums = np.zeros(4)
    _contrasts(lines, low, scale, min(STRIP, len(lines)), sums)
    return tuple(  # type: ignore[return-value]
        float(near / far) if far > 0 else math.nan for near, far in (sums[:2], sums[2:])
    )


def _lines(frame: Frame) -> NDArray[Any]:
    """The rows that are used: all of a small frame, strips of STRIP rows of a large one."""
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


@njit(nogil=True, inline="always")
def _clipped(x, most):
    return min(max(x, -most), most)


@njit(nogil=True, cache=True, fastmath={"contract", "reassoc"})
def _product(one, two):
    total = np.float32(0)
    for i in range(one.size):
        total += one[i] * two[i]
    return total


@njit(nogil=True, cache=True, fastmath={"contract", "reassoc"})
def _contrasts(lines, dark, scale, strip, sums):
    """Fills `sums`: near and far along the rows, near and far along the columns."""
    rows, cols = lines.shape
    light, lit = np.empty((strip, cols), np.float32), np.empty((strip, cols), np.float32)
    steepest = np.float32(STEEPEST)
    near, far = np.empty((2, cols), np.float32), np.empty((2, cols), np.float32)  # of a row and the one before
    for top in range(0, rows - strip + 1, strip):
        for row in range(strip):
            for col in range(cols):
                light[row, col] = (np.float32(lines[top + row, col]) - dark[top + row, col]) * scale[top + row, col]
                lit[row, col] = np.float32(scale[top + row, col] > 0)
        for row in range(strip):
            now, before, full = row % 2, 1 - row % 2, lit[row]
            x = light[row]
            for col in range(cols - FAR):
                known = full[col] * full[col + FAR // 2] * full[col + FAR]
                near[now, col] = known * _clipped(x[col] - 2 * x[col + FAR // 2] + x[col + FAR], steepest)
                far[now, col] = known * _clipped(x[col + FAR] - x[col], steepest)
            if row > 0:
                sums[0] += _product(near[now, : cols - FAR], near[before, : cols - FAR])
                sums[1] += _product(far[now, : cols - FAR], far[before, : cols - FAR])
        for row in range(strip - FAR):
            one, two, three = light[row], light[row + FAR // 2], light[row + FAR]
            for col in range(cols):
                known = lit[row, col] * lit[row + FAR // 2, col] * lit[row + FAR, col]
                near[0, col] = known * _clipped(one[col] - 2 * two[col] + three[col], steepest)
                far[0, col] = known * _clipped(three[col] - one[col], steepest)
            sums[2] += _product(near[0, 1:], near[0, :-1])
            sums[3] += _product(far[0, 1:], far[0, :-1])
