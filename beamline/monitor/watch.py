"""Monitor: runs all checks on each frame and returns their flags. Its state is an immutable value."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from numbers import Integral, Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.monitor.change import MOST_STEPS, SPAN, change_of, running_mean
from beamline.monitor.check import Check, CheckResult, Flag, Level, ScanContext, at_edges, exposure_ratio
from beamline.monitor.checks import CHECKS
from beamline.monitor.digest import FrameDigest, block_side
from beamline.monitor.field import PixelsCheck
from beamline.monitor.motion import Shake
from beamline.monitor.view import (
    NO_SPOTS,
    CellGrid,
    CellView,
    dimmer_than_flats,
    grid_of,
    remaining_intensity,
    spots_of,
    view_of,
)
from drivers.base.frame import Frame, FrameKind

# line integral at the edges up to which the whole sample counts as being inside the field of view, as for the check
# `field`
AIR = 0.1
FORGET = 0.99  # weight per projection, because material that was at the edge 90° ago may come back
NEAREST, FARTHEST = 0.25, MOST_STEPS + 0.5  # planned steps from a projection to its neighbour
SAME, SAME_ANGLE = 0.1, math.radians(0.02)  # planned steps (rad, if the steps are not known) within one projection
ONE_WAY = 0.75  # share of the steps that must have one direction; golden angles have 0.62
# angle between projections that are kept for later projections near them; number of kept projections
EVERY, MOST = math.radians(5), 72
DARK = 0.5  # smallest remaining intensity of a projection; a projection with less is skipped, see the check `lost`

# share of the pixels, beyond that of the last good projection, that may be saturated, because nine tenths of the places
# measure the intensity
FLOODED = 0.1


@dataclass(frozen=True, eq=False)
class Monitor:
    """The monitor's state after the frames so far.

    Attributes:
        context: the scan, and the mean references of the latest groups.
        checks: the checks with their limits. states: states of the checks, in their order. kind, counted: kind and
            number of the frames of the latest group. before: digest of the previous frame; None before the first frame.
            recent: the last projections with beam, oldest first; each is a neighbour in angle of the one before.
            spread_views: a projection with beam every few degrees. cut: usual line integral at the worse edge of the
            field of view, over the projections so far. shake: shaking of the sample, over the projections so far.
            saturated: fraction of saturated pixels in the last good projection; 1 before the first projection.
    """

    context: ScanContext
    checks: tuple[Check, ...]
    states: tuple[Any, ...]
    kind: FrameKind = FrameKind.INVALID
    counted: int = 0
    before: FrameDigest | None = None
    recent: tuple[CellView, ...] = ()
    spread_views: tuple[CellView, ...] = ()
    cut: float = 0.0
    shake: Shake = field(default_factory=Shake)
    saturated: float = 1.0


def usual_step(angles: NDArray[np.float64]) -> float:
    """Median step between these angles, in the order of their projections. NaN if the steps are not in one direction
    (golden or random angles), because then the next projection is not the neighbour in angle."""
    steps = np.diff(np.where(np.isfinite(angles), angles, np.nan))
    steps = steps[np.isfinite(steps) & (steps != 0)]
    share = float((steps > 0).mean()) if steps.size else 0.5
    return float(np.median(steps)) if max(share, 1 - share) > ONE_WAY else math.nan


def start(context: ScanContext, checks: Sequence[Check] = CHECKS) -> Monitor:
    """A monitor before the first frame."""
    return Monitor(context, tuple(checks), tuple(check.start() for check in checks))


class CheckError(Exception):
    """A check raised an exception, which is the cause of this error. `name` is the name of the check."""

    def __init__(self, name: str) -> None:
        super().__init__(f"the check {name} failed")
        self.name = name


def without(monitor: Monitor, name: str) -> Monitor:
    """The monitor without the check of this name."""
    remaining = [
        (check, state) for check, state in zip(monitor.checks, monitor.states, strict=True) if check.name != name
    ]
    return replace(
        monitor, checks=tuple(check for check, _ in remaining), states=tuple(state for _, state in remaining)
    )


def look(
    monitor: Monitor, frame: Frame, digest: FrameDigest, begin: Callable[[str], None] = lambda name: None
) -> tuple[Monitor, tuple[Flag, ...]]:
    """Check the next frame. Returns the monitor after this frame, and the flags. The effort is O(blocks of the
    preview).

    Args:
        begin: function called with the name of each check before the check runs.

    Raises:
        CheckError: a check raised any exception, or did not return a `CheckResult`. The given monitor is unchanged:
            continue with the monitor `without` that check.
    """
    if blank := digest.invalid_fraction == 1:  # only the check `pixels` can report anything
        monitor = replace(monitor, context=replace(monitor.context, view=None, change=None, spots=NO_SPOTS))
    else:
        digest = _without_holes(digest)
        monitor = _with_view(monitor, frame, digest)
    looks: list[CheckResult[Any]] = []
    for check, state in zip(monitor.checks, monitor.states, strict=True):
        if blank and not isinstance(check, PixelsCheck):
            looks.append(CheckResult(state))
            continue
        begin(check.name)
        try:
            looks.append(_valid(check.look(state, frame, digest, monitor.context), check.name, frame.index))
        except BaseException as error:  # caught, because a plug-in may call sys.exit
            if isinstance(error, KeyboardInterrupt) and threading.current_thread() is threading.main_thread():
                raise  # Ctrl-C
            raise CheckError(check.name) from error
    after = monitor if blank else replace(_with_reference(monitor, frame, digest), before=digest)
    after = replace(after, states=tuple(look.state for look in looks))
    unbroken = frame.index - after.counted + 1
    return after, tuple(_from(look.flag, unbroken) for look in looks if look.flag is not None)


def look_past_failures(
    monitor: Monitor, frame: Frame, digest: FrameDigest, begin: Callable[[str], None] = lambda name: None
) -> tuple[Monitor, tuple[Flag, ...], tuple[str, ...]]:
    """The same as `look`, but a check that fails is switched off. Also returns a sentence on each such check."""
    failures: list[str] = []
    while True:
        try:
            monitor, flags = look(monitor, frame, digest, begin)
        except CheckError as failed:
            monitor = without(monitor, failed.name)
            cause = failed.__cause__
            failures.append(
                f"{failed} at frame {frame.index} and is switched off; the other checks continue: {cause!r}"
            )
        else:
            return monitor, flags, tuple(failures)


def _without_holes(digest: FrameDigest) -> FrameDigest:
    """The digest, in which blocks without a valid pixel have the median of the frame."""
    holes = np.isnan(digest.preview)
    if not holes.any():
        return digest
    preview, peaks = (np.where(holes, np.nanmedian(each), each) for each in (digest.preview, digest.peaks))
    return replace(digest, preview=preview, peaks=peaks)


def _valid(answer: Any, name: str, row: int) -> CheckResult[Any]:
    """The result of a check, after a test that it can be used. Raises TypeError or ValueError if it cannot."""
    if not isinstance(answer, CheckResult) or type(answer.flag) not in (Flag, type(None)):
        raise TypeError(f"the check returned {answer!r:.80}; expected a CheckResult with a Flag or None")
    if (flag := answer.flag) is None:
        return answer
    rows, boxes = (flag.frame if flag.first is None else flag.first, flag.frame), (flag.region, flag.from_region)
    numbers = (flag.score, flag.limit, *(side for box in boxes for side in box or ()))
    typed = (
        isinstance(flag.level, Level)
        and isinstance(flag.advice, str)
        and all(isinstance(row, Integral) for row in rows)
        and all(isinstance(number, Real) for number in numbers)
    )
    if not typed or any(len(box) != 4 for box in boxes if box is not None):
        raise TypeError(f"the check returned a flag in which a field has the wrong type: {flag!r:.300}")
    if flag.check != name or rows[0] > rows[1] or not 0 <= rows[1] <= row:  # `_from` removes rows that are too early
        first_row = rows[0]
        last_row = rows[1]
        raise ValueError(
            f"the check returned a flag for the check {flag.check!r} and frames {first_row} to {last_row}; expected a "
            f"flag for the check {name!r} and frames up to {row}"
        )
    return answer


def _from(flag: Flag, row: int) -> Flag:
    """The flag without rows before this row."""
    return flag if flag.first is None else replace(flag, first=max(flag.first, row))


def _with_view(monitor: Monitor, frame: Frame, digest: FrameDigest) -> Monitor:
    """The monitor with the quantities of a projection that all checks need."""
    context = monitor.context
    spots = spots_of(frame, digest, monitor.before, context.dark, context.saturation)
    context = replace(context, view=None, change=None, light_left=1.0, spots=spots, follows=True)
    if frame.kind is not FrameKind.PROJECTION:
        return replace(monitor, context=context)
    grid = context.grid
    if grid is None:
        block = block_side(frame.counts.shape, digest.preview.shape)
        grid = grid_of(digest.preview.shape, block, context.dark, context.flat)
    longer = exposure_ratio(context, frame.exposure) if grid.flats else 1.0
    view = view_of(digest.preview, grid, frame.index, frame.angle, longer)
    recent, last = monitor.recent, monitor.recent[-1] if monitor.recent else None
    steps = math.nan if last is None else math.remainder(view.angle - last.angle, 2 * math.pi) / context.step
    if last is not None and context.frames_per_view > 1 and _of_one_view(view.angle - last.angle, context.step):
        # The frame shows the same as the first frame of its projection.
        return replace(monitor, context=replace(context, grid=grid, light_left=remaining_intensity(view, last, grid)))
    follows = math.isnan(steps) or NEAREST < steps < FARTHEST
    if not follows:  # the projection to compare with must be the neighbour in angle
        recent, last = (), _nearest(view.angle, monitor.spread_views)
        context = replace(context, spots=spots._replace(n=0))
    remaining = remaining_intensity(view, last, grid)
    context = replace(context, grid=grid, light_left=remaining, follows=follows)
    if remaining < DARK or digest.saturated_fraction > monitor.saturated + FLOODED:
        return replace(monitor, context=context)  # not used as a measure for later projections
    return _with_good_view(replace(monitor, context=context, saturated=digest.saturated_fraction), view, recent, grid)


def _with_good_view(monitor: Monitor, view: CellView, recent: tuple[CellView, ...], grid: CellGrid) -> Monitor:
    """The monitor after a projection with beam. recent: the projections before it, each a neighbour in angle of the
    next."""
    context = monitor.context
    change = change_of(view, recent, grid)
    view = replace(view, brighter=0.0 if change is None else math.log1p(change.gain))
    spread_views = monitor.spread_views
    if len(spread_views) < MOST and math.isfinite(view.angle) and _nearest(view.angle, spread_views) is None:
        spread_views = (*spread_views, view)
    shake = monitor.shake.with_change(change)
    dimmer = dimmer_than_flats(view, grid, context.dimmer)
    context = replace(context, view=view, change=change, dimmer=dimmer, shake=shake.size)
    cut = max(*at_edges(context), FORGET * monitor.cut)
    context = replace(context, truncated=not grid.flats or cut > AIR)
    return replace(
        monitor, context=context, recent=(*recent, view)[-SPAN:], spread_views=spread_views, cut=cut, shake=shake
    )


def _of_one_view(distance: float, step: float) -> bool:
    """Largest difference in radians between two frames that belong to one projection."""
    return abs(math.remainder(distance, 2 * math.pi)) < (SAME_ANGLE if math.isnan(step) else SAME * abs(step))


def _nearest(angle: float, spread_views: Sequence[CellView]) -> CellView | None:
    """The projection nearest in angle, if it is within EVERY; otherwise None."""
    distances = [abs(math.remainder(angle - view.angle, 2 * math.pi)) for view in spread_views]
    return spread_views[int(np.argmin(distances))] if distances and min(distances) < EVERY else None


def _with_reference(monitor: Monitor, frame: Frame, digest: FrameDigest) -> Monitor:
    """The monitor after a dark or a flat, whose preview is added to the mean of its group."""
    counted = monitor.counted + 1 if frame.kind is monitor.kind else 1
    context = monitor.context
    if frame.kind is FrameKind.DARK:
        context = replace(context, dark=running_mean(context.dark, digest.preview, counted), grid=None)
    elif frame.kind is FrameKind.FLAT:
        flat = running_mean(context.flat, digest.preview, counted)
        context = replace(context, flat=flat, flat_exposure=frame.exposure, grid=None)
    return replace(monitor, context=context, counted=counted, kind=frame.kind)
