"""Replay: runs the checks of the monitor over the frames of a file. The file may have any format and may still be
growing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

from beamline.monitor.change import SPAN
from beamline.monitor.check import Check, Flag, Level, ScanContext
from beamline.monitor.checks import CHECKS, flagged_frames
from beamline.monitor.digest import check_block, digest
from beamline.monitor.references import ReferenceLimits
from beamline.monitor.watch import look_past_failures, start
from beamline.projections.replayed_frames import context_of, frames_of
from beamline.storage.flag_legend import FrameFlags
from beamline.storage.readers.base import ScanSource
from beamline.storage.rules.evidence import EvidenceRequest, ScanEvidence
from beamline.storage.rules.scan import altered_sentence
from drivers.base.clock import Clock
from drivers.base.frame import FrameKind


@dataclass(frozen=True)
class SkippedChecks:
    """Number of exposed projections so far, and for how many of them each check was skipped.

    Attributes:
        views: number of exposed projections.
        without_earlier: number of projections that were not compared with earlier projections.
        without_flats, in_cone, wider_than_field: numbers of projections for which checks were skipped because the scan
            has no flats, because the beam is a cone, or because the sample is wider than the field of view.
    """

    views: int = 0
    without_earlier: int = 0
    without_flats: int = 0
    in_cone: int = 0
    wider_than_field: int = 0

    def with_frame(self, context: ScanContext) -> SkippedChecks:
        """The counts after the next frame. `context` contains what the checks knew about this frame."""
        if context.view is None or context.grid is None:
            return self
        return SkippedChecks(
            self.views + 1,
            self.without_earlier + (context.change is None),
            self.without_flats + (not context.grid.flats),
            self.in_cone + context.cone,
            self.wider_than_field + (context.truncated and context.grid.flats),
        )

    def in_words(self) -> tuple[str, ...]:
        """The skipped checks, each as a text with the number of projections and the reason. The first projections have
        no predecessors; they are mentioned only if this is true for all projections.
        """
        without_earlier = self.without_earlier if self.without_earlier > min(SPAN, self.views - 1) else 0
        reasons = (
            ("drift of beam, field, opposite, mass", self.without_flats, "no flats"),
            (
                "gain, motion, floater, ghost, dips of beam",
                without_earlier,
                "fewer than four projections at equal angular steps came before",
            ),
            ("opposite", self.in_cone, "cone beam"),
            ("mass", self.wider_than_field, "sample wider than the field of view"),
        )
        return tuple(f"{checks} in {n} of {self.views} projections ({reason})" for checks, n, reason in reasons if n)


@dataclass(frozen=True, eq=False)
class FrameVerdict:
    """The flags of a frame, and the state of the checks after it.

    Attributes:
        row: row of the frame in the file.
        kind: kind of the frame.
        flags: flags of the checks.
        n_frames: number of frames in the file so far.
        skipped: number of projections for which each check was skipped so far.
        failures: a sentence for each check that failed with an error at this frame. The check is not used from then on.
    """

    row: int
    kind: FrameKind
    flags: tuple[Flag, ...]
    n_frames: int
    skipped: SkippedChecks
    failures: tuple[str, ...] = ()


@dataclass(frozen=True)
class FlagKind:
    """All flags of a check at one level.

    Attributes:
        frames: numbers of the flagged frames in the file, ascending.
        worst: the flag with the largest ratio of score to limit.
    """

    check: str
    level: Level
    frames: tuple[int, ...]
    worst: Flag


@dataclass(frozen=True)
class ScanVerdict:
    """The result of the monitor for a whole scan.

    Attributes:
        n_frames: number of frames that were checked.
        kinds: the flags by check and level, the worst level first.
        alarmed: numbers of the frames with an alarm, without those that were taken again.
        retaken: numbers of the projections that were taken again.
        references: faults of darks and flats, a text for each group.
        altered: a sentence that says which data in the file do not match their checksums; "" if all data match.
        aside: texts that say which checks skipped how many projections, and which checks failed with an error.
    """

    n_frames: int
    kinds: tuple[FlagKind, ...]
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
        """True if no frame has an alarm, and darks and flats have no fault."""
        return not self.alarmed and not self.references


def replay(
    source: ScanSource,
    checks: Sequence[Check] = CHECKS,
    *,
    follow: Clock | None = None,
    should_stop: Callable[[], bool] = lambda: False,
) -> Iterator[FrameVerdict]:
    """Check every frame, in the order of the file.

    Line integrals are converted to counts of a beam without noise and then checked. Unknown exposures count as equal.

    Args:
        follow: clock for waiting for further frames until the file is finished; None: only the frames that are already
            in the file are checked.
        should_stop: function that is called before each frame; True ends the replay.

    Raises:
        DataError: the file stopped growing before it was finished (only with `follow`).
    """
    monitor, skipped = start(context_of(source), checks), SkippedChecks()
    for frame, n in frames_of(source, follow=follow, should_stop=should_stop):
        frame_digest = digest(frame.counts, monitor.context.saturation, check_block(source.shape))
        monitor, flags, failures = look_past_failures(monitor, frame, frame_digest)
        skipped = skipped.with_frame(monitor.context)
        yield FrameVerdict(frame.index, frame.kind, flags, n, skipped, failures)


def verdict(
    source: ScanSource, frame_verdicts: Sequence[FrameVerdict], limits: ReferenceLimits | None = None
) -> ScanVerdict:
    """The verdict about the frames, together with the faults of darks, flats and the file.

    Args:
        limits: limits for darks and flats; None: the default limits.
    """
    flags = [flag for frame_verdict in frame_verdicts for flag in frame_verdict.flags]
    retaken = frozenset(source.table.replaced.tolist())
    findings = ScanEvidence(source, EvidenceRequest(limits=limits)).findings
    failures = tuple(failure for frame_verdict in frame_verdicts for failure in frame_verdict.failures)
    return ScanVerdict(
        n_frames=len(frame_verdicts),
        kinds=by_kind(flags),
        alarmed=tuple(sorted({n for flag in flags if flag.level is Level.ALARM for n in flag.frames} - retaken)),
        retaken=tuple(sorted(retaken)),
        references=tuple(finding.message for finding in findings if finding.frames),
        altered=altered_sentence(source) if source.table.altered.any() else "",
        aside=failures + (frame_verdicts[-1].skipped.in_words() if frame_verdicts else ()),
    )


def judged_flags(source: ScanSource) -> FrameFlags:
    """Flags of the frames recorded so far, as the monitor would have written them."""
    return FrameFlags.of_flags([judged.flags for judged in replay(source)])


def by_kind(flags: Iterable[Flag]) -> tuple[FlagKind, ...]:
    """Flags by check and level, the worst level first, then by descending number of frames."""
    grouped: dict[tuple[str, Level], list[Flag]] = {}
    for flag in flags:
        grouped.setdefault((flag.check, flag.level), []).append(flag)
    kinds = [
        FlagKind(*key, tuple(sorted(frames)), max(grouped[key], key=_excess))
        for key, frames in flagged_frames(chain.from_iterable(grouped.values())).items()
    ]
    levels = (Level.ALARM, Level.WARN, Level.INFO)
    return tuple(sorted(kinds, key=lambda kind: (levels.index(kind.level), -len(kind.frames))))


def counts_of(kinds: Iterable[FlagKind]) -> Mapping[str, Mapping[str, int]]:
    """Number of frames by check, then by level."""
    counts: dict[str, dict[str, int]] = {}
    for kind in kinds:
        counts.setdefault(kind.check, {})[str(kind.level)] = len(kind.frames)
    return counts


def _excess(flag: Flag) -> float:
    score = abs(flag.score)
    return score / abs(flag.limit) if flag.limit else score
