"""Replay: the monitor's checks over the frames of a file, of any format, finished or growing."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.monitor.change import SPAN
from beamline.monitor.check import Check, Flag, Level, ScanContext
from beamline.monitor.checks import CHECKS, flagged_frames
from beamline.monitor.digest import check_block, digest
from beamline.monitor.evidence import full_scale
from beamline.monitor.references import ReferenceLimits
from beamline.monitor.watch import look_past_failures, start, usual_step
from beamline.storage.flag_legend import FrameFlags
from beamline.storage.hdf5 import NotReadyError
from beamline.storage.interrupted import next_step
from beamline.storage.readers.averaged import stated_frames_per_view
from beamline.storage.readers.base import ScanSource, read_known, rows_replaced
from beamline.storage.rules.angles import FARTHEST
from beamline.storage.rules.references import reference_groups
from beamline.storage.rules.scan import altered_sentence
from beamline.storage.writer_lock import PATIENCE, WriterWatch
from drivers.base.clock import Clock
from drivers.base.frame import Frame, FrameKind
from recon.base.views import spread

BEAM = 50_000.0  # counts that a transmission of 1 is, where a file holds line integrals
SAMPLES = 4  # frames of a kind that tell where the detector saturates
PILED_UP = 1e-3  # fraction of the pixels at the largest count from which it is the end of the detector's range
POLL = 0.1  # s between looks at a growing file


@dataclass(frozen=True)
class SkippedChecks:
    """Number of views with light so far, and for how many of them each check was skipped.

    Attributes:
        views: their number.
        alone: views that were not compared with earlier ones.
        without_flats, cones, wider: views of a scan without flats, of a cone beam, of a sample wider than the field.
    """

    views: int = 0
    alone: int = 0
    without_flats: int = 0
    cones: int = 0
    wider: int = 0

    def with_frame(self, context: ScanContext) -> SkippedChecks:
        """The counts after the next frame; `context` is what the checks knew of it."""
        if context.view is None or context.grid is None:
            return self
        return SkippedChecks(
            self.views + 1,
            self.alone + (context.change is None),
            self.without_flats + (not context.grid.flats),
            self.cones + context.cone,
            self.wider + (context.truncated and context.grid.flats),
        )

    def in_words(self) -> tuple[str, ...]:
        """The skipped checks, the views and the reason, one text each. First views, which lack predecessors, count only
        if all do.
        """
        alone = self.alone if self.alone > min(SPAN, self.views - 1) else 0
        reasons = (
            ("drift of beam, field, opposite, mass", self.without_flats, "no flats"),
            ("gain, motion, floater, ghost, dips of beam", alone, "no four views before them at even steps of angle"),
            ("opposite", self.cones, "cone beam"),
            ("mass", self.wider, "sample wider than the field"),
        )
        return tuple(f"{checks} in {n} of {self.views} views ({why})" for checks, n, why in reasons if n)


@dataclass(frozen=True, eq=False)
class FrameVerdict:
    """The flags of a frame, and the state of the checks after it.

    Attributes:
        row: of the frame, in the file.
        kind: of the frame.
        flags: what the checks found.
        n: frames in the file so far.
        aside: which checks left out views so far.
        failures: a sentence on each check that failed at this frame, and is off from here on.
    """

    row: int
    kind: FrameKind
    flags: tuple[Flag, ...]
    n: int
    aside: SkippedChecks
    failures: tuple[str, ...] = ()


@dataclass(frozen=True)
class Kind:
    """All flags of a check at one level.

    Attributes:
        frames: their numbers in the file, ascending.
        worst: the flag with the largest score over its limit.
    """

    check: str
    level: Level
    frames: tuple[int, ...]
    worst: Flag


@dataclass(frozen=True)
class ScanVerdict:
    """The verdict of the monitor on a whole scan.

    Attributes:
        n_frames: that were looked at.
        kinds: its flags by check and level, the worst level first.
        alarmed: numbers of the frames with an alarm, without those that were taken again.
        retaken: numbers of the views that were taken again.
        references: what is wrong with darks and flats, a text for each group.
        altered: what of the file is not as it was written; "" where all is.
        aside: which checks could not look at which views, or failed.
    """

    n_frames: int
    kinds: tuple[Kind, ...]
    alarmed: tuple[int, ...]
    retaken: tuple[int, ...]
    references: tuple[str, ...]
    altered: str
    aside: tuple[str, ...]

    @property
    def flags(self) -> Mapping[str, Mapping[str, int]]:
        """Number of frames by check, then by level."""
        return counts_of(self.kinds)

    @property
    def clean(self) -> bool:
        """Whether no frame has an alarm, and darks and flats have no fault."""
        return not self.alarmed and not self.references


def replay(
    source: ScanSource,
    checks: Sequence[Check] = CHECKS,
    *,
    follow: Clock | None = None,
    should_stop: Callable[[], bool] = lambda: False,
) -> Iterator[FrameVerdict]:
    """Check every frame, in the order of the file.

    Frames of line integrals are judged as the counts of a beam without noise; exposures that are not known count as
    equal.

    Args:
        follow: the clock to wait by for further frames, until the file is finished; None: the frames that are there.
        should_stop: asked before each frame.

    Raises:
        DataError: a followed file that is not finished and grows no more.
    """
    monitor, aside = start(context_of(source), checks), SkippedChecks()
    for frame, n in frames_of(source, follow=follow, should_stop=should_stop):
        seen = digest(frame.counts, monitor.context.saturation, check_block(source.shape))
        monitor, flags, failures = look_past_failures(monitor, frame, seen)
        aside = aside.with_frame(monitor.context)
        yield FrameVerdict(frame.index, frame.kind, flags, n, aside, failures)


def frames_of(
    source: ScanSource, *, follow: Clock | None = None, should_stop: Callable[[], bool] = lambda: False
) -> Iterator[tuple[Frame, int]]:
    """Every frame, in the order of the file, and how many the file has so far; arguments and errors as for `replay`.

    A view that was taken again later has the kind that it had when it came.
    """
    done = 0
    for n in growing(source, follow) if follow is not None else (source.refresh(),):
        again = frozenset(rows_replaced(source).tolist())
        for frame in _frames(source, done):
            if should_stop():
                return
            if frame.index in again:  # what the monitor saw before it was taken again
                frame = replace(frame, kind=FrameKind.PROJECTION)
            yield frame, n
        done = n


def awaited(
    opened: Callable[[], ScanSource], path: Path, clock: Clock, patience: float = PATIENCE, poll: float = POLL
) -> ScanSource:
    """The scan that begins at `path`, when its file can be read.

    Raises:
        DataError: none begins within `patience` s.
    """
    last = clock.now() + patience
    while True:
        try:
            return opened()
        except NotReadyError as error:
            if clock.now() > last:
                raise DataError(f"No scan began in {path} within {patience:.0f} s.") from error
            clock.sleep(poll)


def growing(source: ScanSource, clock: Clock, patience: float = PATIENCE, poll: float = POLL) -> Iterator[int]:
    """Frames in a file at each look, until it is finished.

    Raises:
        DataError: it is not finished and grows no more.
    """
    writer, n, ended = WriterWatch(source.path, clock.now(), patience), 0, False
    while not ended:
        ended = source.finished  # asked before the frames, so that none can slip in between
        before, n = n, source.refresh()
        yield n
        if not ended and (why := writer.lost(clock.now(), n > before, lambda: source.finished)):
            raise DataError(f"{source.path} {why} and is not finished; it has {n} frames. {next_step(source.path)}")
        if not ended:
            clock.sleep(poll)


def verdict(source: ScanSource, judged: Sequence[FrameVerdict], limits: ReferenceLimits | None = None) -> ScanVerdict:
    """The verdict on the frames, together with the faults of darks, flats and the file.

    Args:
        limits: of darks and flats; None: those of a new scan.
    """
    flags = [flag for each in judged for flag in each.flags]
    again = frozenset(rows_replaced(source).tolist())
    found = reference_groups(source, limits).findings if source.quantity == "counts" else ()
    failures = tuple(failure for each in judged for failure in each.failures)
    return ScanVerdict(
        n_frames=len(judged),
        kinds=by_kind(flags),
        alarmed=tuple(sorted({n for flag in flags if flag.level is Level.ALARM for n in flag.frames} - again)),
        retaken=tuple(sorted(again)),
        references=tuple(finding.message for finding in found if finding.frames),
        altered=altered_sentence(source) if source.altered else "",
        aside=failures + (judged[-1].aside.in_words() if judged else ()),
    )


def judged_flags(source: ScanSource) -> FrameFlags:
    """Flags of the frames recorded so far, as the monitor would have written them."""
    return FrameFlags.of_flags([judged.flags for judged in replay(source)])


def by_kind(flags: Iterable[Flag]) -> tuple[Kind, ...]:
    """Flags by check and level, the worst level first, then by descending number of frames."""
    grouped: dict[tuple[str, Level], list[Flag]] = {}
    for flag in flags:
        grouped.setdefault((flag.check, flag.level), []).append(flag)
    kinds = [
        Kind(*key, tuple(sorted(frames)), max(grouped[key], key=_excess))
        for key, frames in flagged_frames(chain.from_iterable(grouped.values())).items()
    ]
    levels = (Level.ALARM, Level.WARN, Level.INFO)
    return tuple(sorted(kinds, key=lambda kind: (levels.index(kind.level), -len(kind.frames))))


def counts_of(kinds: Iterable[Kind]) -> Mapping[str, Mapping[str, int]]:
    """Number of frames by check, then by level."""
    counts: dict[str, dict[str, int]] = {}
    for kind in kinds:
        counts.setdefault(kind.check, {})[str(kind.level)] = len(kind.frames)
    return counts


def context_of(source: ScanSource) -> ScanContext:
    """What the checks need to know of a file before its first frame.

    The period is known of our own fly scans only.
    """
    rows, cols = source.shape
    fly = source.plan.get("mode") == "fly"
    period = (float(source.attributes.get("period_s", 0)) or None) if fly else None
    context = ScanContext(
        _saturation(source), rows * cols, period, _step(source), stated_frames_per_view(source),
        cone=source.cone is not None, axis_col=source.axis_col,
    )  # fmt: skip
    if source.quantity != "line_integrals":
        return context
    preview = digest(np.zeros(source.shape, np.uint16), preview_bin=check_block(source.shape)).preview
    return replace(context, dark=preview, flat=preview + np.float32(BEAM), flat_exposure=1.0, integrals=True)


def _step(source: ScanSource) -> float:
    """Radians from a view to the next, as the plan of our own scans has them, or as the file has its views."""
    planned = source.plan.get("angles_deg")
    if isinstance(planned, list) and all(isinstance(angle, int | float) for angle in planned):
        return usual_step(np.radians(planned[:: stated_frames_per_view(source)]))
    return usual_step(source.angles[source.image_key == FrameKind.PROJECTION])


def _saturation(source: ScanSource) -> float:
    """Saturation as the file states it; else the end of the pixels' type, or of fewer bits where pixels pile up
    there. Inf where pixels are real numbers."""
    if source.quantity == "line_integrals" or source.dtype.kind not in "ui":
        return np.inf
    stated = float(source.attributes.get("saturation", 0))
    if 0 < stated <= np.iinfo(source.dtype).max:
        return stated
    for kind in (FrameKind.FLAT, FrameKind.PROJECTION):
        rows = np.flatnonzero(source.image_key == kind)
        for row in spread(rows, SAMPLES):
            image = read_known(source, [int(row)])[0]
            largest = float(image.max())
            if largest == full_scale(largest) and (image == image.max()).mean() > PILED_UP:
                return largest
    return float(np.iinfo(source.dtype).max)


def _frames(source: ScanSource, first: int) -> Iterator[Frame]:
    """Frames from `first` on. An angle that no stage reaches becomes NaN. An unknown exposure becomes 1 s, so that
    views and flats agree."""
    for frame in source.frames(first) if source.dtype == np.uint16 else _plain_frames(source, first):
        angle = frame.angle if abs(frame.angle) <= math.radians(FARTHEST) else math.nan
        yield replace(frame, angle=angle, exposure=frame.exposure if frame.exposure > 0 else 1.0)


def _plain_frames(source: ScanSource, first: int) -> Iterator[Frame]:
    """Frames of other types than a camera's: counts as they are, line integrals as counts of a beam."""
    for row in range(first, source.image_key.size):
        pixels: NDArray[Any] = read_known(source, [row])[0]
        if source.quantity == "line_integrals":
            with np.errstate(over="ignore"):
                pixels = np.nan_to_num(BEAM * np.exp(-pixels.astype(np.float64)), posinf=65535).clip(0, 65535)
            pixels = pixels.round().astype(np.uint16)
        elif (kernel := _type_of_kernels(pixels.dtype)) != pixels.dtype:
            pixels = pixels.astype(kernel)
        kind, angle = FrameKind(int(source.image_key[row])), float(source.angles[row])
        kind = FrameKind.INVALID if row in source.unreadable else kind
        yield Frame(pixels, kind, row, row, -1, angle, np.nan, float(source.exposures[row]))


def _type_of_kernels(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """The type that holds such pixels for compiled kernels, which know neither foreign orders of bytes nor floats of 16
    or more than 64 bits."""
    if dtype.kind == "f" and dtype.itemsize not in (4, 8):
        return np.dtype(np.float32 if dtype.itemsize == 2 else np.float64)
    return dtype.newbyteorder("=")


def _excess(flag: Flag) -> float:
    score = abs(flag.score)
    return score / abs(flag.limit) if flag.limit else score
