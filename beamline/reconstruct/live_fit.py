"""Live fit: reconstructs a volume from the frames of a running scan. A state machine with four states.

```
WAITS_FOR_REFERENCES --darks and flats can be used--> WAITS_FOR_AXIS --its column is known--> FEEDS --finish--> ENDED
```

Each reading of the file goes as far as possible: with the first projection it may pass two states and feed a batch.
`Cursor` states how far the fit has come in the file.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.events import Sink, StateEntered
from beamline.core.recon_events import ReconStarted
from beamline.core.sinks import Warnings
from beamline.core.text import count, frames_text
from beamline.projections.consistency import compare_with_flats
from beamline.projections.correction import ScanCorrection
from beamline.projections.prepare import assemble
from beamline.projections.prepared import PreparedProjections
from beamline.projections.protocols import PlaceStep, ScanStep
from beamline.projections.registry import in_order
from beamline.projections.selection import check_axis
from beamline.projections.step import StepDone
from beamline.projections.usable_views import UsableViews
from beamline.projections.views import ViewGeometry, checked_views, evidence_request, refuse
from beamline.reconstruct.followed_views import AxisSearch, Cursor, FollowedViews, FollowState, PassLaws
from beamline.reconstruct.job import corrections_done, progress_events
from beamline.reconstruct.options import ReconOptions
from beamline.reconstruct.snapshots import LiveSlices, Snapshots
from beamline.storage.readers.base import ScanSource
from beamline.storage.rules.evidence import ScanEvidence
from beamline.storage.rules.scan import BEFORE_VIEWS, findings_of
from drivers.base.clock import Clock
from recon.base.method import Progress
from recon.prep.projections import Projections, merge_and_empty
from recon.splatting.stream import StreamingFit
from recon.splatting.time_limit import FinalFit

_NONE, _ONE_VIEW = np.empty(0, np.int64), np.zeros(1)  # rows of the file; rad
BATCH_VIEWS = 32  # projections that are corrected before the fit continues
_LEAST_VIEWS = 16  # projections needed for a volume after a stop
_BEHIND = (
    0.5  # steps per projection; below this, FBP matches the projections better (tests/bench/test_live_accuracy.py)
)
_AXIS_MOVES = 1.0  # px; a larger change of the axis restarts the fit

# Reasons to correct all projections again.
_OUTDATED = (
    "Correcting all projections again, for one of these reasons: new flats or darks arrived, the air columns changed, "
    "or new angles lie between earlier ones (neighbours in angle are used to find zingers)"
)
_NEXT_PART = (
    "Correcting all projections again, because the next part of the run starts: each projection is corrected "
    "with the flats of its own part"
)
_SEVERAL_PARTS = "Correcting all projections again at the end of the run, because the run has several parts"
_OFFSET = "Correcting all projections again, now together with the laterally offset projections"
_SHADED = (
    "Correcting all projections again, because an object is in the beam in all projections, but not in the "
    "flats: its rays are no longer used"
)


class ScanFollower:
    """Follows the file of a running scan and updates the volume. The caller decides when to read, to fit and to
    finish."""

    def __init__(self, options: ReconOptions, source: ScanSource, sink: Sink, clock: Clock, warn: Warnings) -> None:
        self.source = source
        self.state = FollowState.WAITS_FOR_REFERENCES
        self._options, self._sink, self._clock, self._warn = options, sink, clock, warn
        self._selection = options.selection.of(source)
        self.views, self._cursor = FollowedViews(source, self._selection), Cursor()
        self._references_follow = False  # darks or flats come after the views
        self._axis = AxisSearch(source, self._selection, warn)
        self._scan = ScanEvidence(source, evidence_request(source, self._selection))
        self._correction: ScanCorrection | None = None  # None: waits for references
        self._fit: StreamingFit | None = None
        self._history: list[Progress] = []
        self._begin = clock.now()
        self._uncorrected = 0  # views in the file that the fit has not got yet
        self._said_behind = False
        self._tell_progress = progress_events(sink, clock, waiting=lambda: self.waiting)
        self._laws = PassLaws(self.views, options.seed, sink, clock, warn)
        self.snapshots = Snapshots(options, source, sink, clock, warn)
        self._slices = LiveSlices(self.views, self.snapshots, clock)

    @property
    def axis_col(self) -> float | None:
        """The rotation axis in pixels of the file; None while unknown."""
        return self._axis.col

    @property
    def n_views_taken(self) -> int:
        """Number of projections that the fit has used."""
        cursor = self._cursor
        return sum(batch.view_ids.size for batch in cursor.batches) + (cursor.newest is not None)

    @property
    def waiting(self) -> int:
        """Number of projections in the file that the fit has not used yet."""
        return self._uncorrected + (0 if self._fit is None else self._fit.n_unlearnt)

    @property
    def has_volume(self) -> bool:
        """True if the fit has used enough projections to give a volume if it stops now."""
        return self._fit is not None and self._fit.started and self.n_views_taken >= _LEAST_VIEWS

    def take_new_frames(self, ended: bool) -> bool:
        """Read the file and feed the fit with at most one batch of new projections. Returns True if the file has
        grown."""
        assert self.state is not FollowState.ENDED
        n = self.source.refresh()
        grown = n > self._cursor.frames
        views = self.views.chosen(self.views.usable().frames)
        self._cursor = replace(self._cursor, frames=n, taken=self._cursor.taken if views.size else n)
        if views.size:
            self._step(views, ended)
        self._uncorrected = int((views >= self._cursor.taken).sum())
        return grown

    def _step(self, views: NDArray[np.int64], ended: bool) -> None:
        """Go through the states as far as the views of the file allow, and feed one batch."""
        if self.state is FollowState.WAITS_FOR_REFERENCES and self._references_are_there(ended):
            self.state = FollowState.WAITS_FOR_AXIS
        if self.state is not FollowState.WAITS_FOR_REFERENCES and not self._axis.settled:
            self._look_for_axis(views, ended)
        if self.state is FollowState.WAITS_FOR_AXIS and self.axis_col is not None:
            self.state = FollowState.FEEDS
        if self.state is FollowState.FEEDS:
            self._feed_batch(views, ended)

    def _references_are_there(self, ended: bool) -> bool:
        """Whether darks and flats can be used; if so, the correction begins.

        Those that come after the views are all there when the scan has ended, not before.

        Raises:
            DataError: the scan has ended, or something else is missing, and nothing will come.
        """
        self._scan = self._scan.renewed()
        blockers = findings_of(self._scan, BEFORE_VIEWS)
        if not ended and (self._references_follow or any(finding.rule == "references" for finding in blockers)):
            if not self._references_follow:
                message = (
                    "No live volume during this scan, because no darks or no flats were taken before the projections. "
                    "The reconstruction starts after the scan"
                )
                self._sink(StateEntered("waiting", message, time=self._clock.now()))
            self._references_follow = True
            return False
        refuse(self.source, blockers)
        self._correction = ScanCorrection(self._scan, self._selection, self._warn)
        self._tell(self._correction.plan.done)
        return True

    def _look_for_axis(self, views: NDArray[np.int64], ended: bool) -> None:
        """Look for the axis. After a large move the fit begins anew with all views; after a small one it goes on."""
        assert self._correction is not None
        before = self.axis_col
        self._axis.look(self._correction, views, ended)
        if self._fit is None or before is None or self.axis_col is None or self.axis_col == before:
            return
        if abs(self.axis_col - before) > _AXIS_MOVES:
            self._fit = None
        else:
            self._fit.move_axis(self._selection.geometry(self.axis_col, _ONE_VIEW).axis_col)

    def _feed_batch(self, views: NDArray[np.int64], ended: bool) -> None:
        """Feed the fit with the next views, all of one part of the file, as each part has its own references."""
        assert self.axis_col is not None
        if self._fit is None:
            self._fit = self._new_fit(self.axis_col)
        new = views[views >= self._cursor.taken]
        parts = np.searchsorted(self.source.table.part_starts, new, "right") - 1
        if new.size and parts[0] != self._cursor.part:
            self._begin_part(int(parts[0]))
        batch = new[parts == parts[:1]][:BATCH_VIEWS]
        all_taken = batch.size == new.size
        self._feed(batch, last=ended and all_taken)
        self._cursor = replace(self._cursor, taken=self._cursor.frames if all_taken else int(batch[-1]) + 1)

    def _begin_part(self, part: int) -> None:
        """Begin a later part of the file: correct its views by its own references.

        The fit takes in the last view of the part before, which waited for the next, and learns all views again.
        """
        assert self._correction is not None
        self._cursor = replace(self._cursor, part=part)
        self._settle_newest()
        if self._cursor.batches:
            self.correct_again(self.views.usable(), _NEXT_PART)
        else:
            self._correction = self._correction.renewed()

    def _settle_newest(self) -> None:
        """Correct the newest view for good: no other comes that it waits for."""
        if self._cursor.newest is not None:
            self._feed(_NONE, last=True)

    def _feed(self, frames: NDArray[np.int64], last: bool) -> None:
        """Correct frames and feed the fit with them, also with the newest, whose correction waits for the next one."""
        assert self._correction is not None and self._fit is not None
        batch, newest = self._correction.feed(frames, last=last), self._cursor.newest
        if batch is not None:
            data, views = batch.measured, batch.view_ids
            if newest is not None:
                if not np.array_equal(data[0], newest.measured[0], equal_nan=True):
                    self._fit.replace_newest(data[0])
                data, views, newest = data[1:], views[1:], None
            self._cursor = replace(self._cursor, batches=(*self._cursor.batches, batch), newest=None)
            if views.size:
                self._fit.add_views(data, self._angles(views))
        if newest is None and (newest := self._correction.newest()) is not None:
            self._cursor = replace(self._cursor, newest=newest)
            self._fit.add_views(newest.measured, self._angles(newest.view_ids))

    def catch_up(self, should_stop: Callable[[], bool]) -> None:
        """Read the remaining frames of a scan that has ended; after a stop, only those that a volume needs."""
        while self._cursor.behind:
            if self.n_views_taken >= _LEAST_VIEWS and should_stop():
                self._warn(
                    f"Stopped: the volume is reconstructed from the first {self.n_views_taken} of {self.views.n} "
                    "projections."
                )
                return
            self.take_new_frames(ended=True)

    def _angles(self, view_ids: NDArray[np.int64]) -> NDArray[np.float64]:
        assert self.axis_col is not None  # the fit has an axis
        return self.views.angles(self.axis_col, view_ids)

    def _new_fit(self, axis_col: float) -> StreamingFit:
        check_axis(self.source, axis_col)
        options, again = self._options, bool(self._history)
        now = self._clock.now()
        self._sink(ReconStarted(self.source.path, options.method.name, self.views.n, axis_col, again, time=now))
        fit = options.streaming.stream(self._selection.geometry(axis_col, _ONE_VIEW), options.seed, self._clock.now)
        for batch in self._cursor.batches:
            fit.add_views(batch.measured, self.views.angles(axis_col, batch.view_ids))
        self._cursor = replace(self._cursor, newest=None)  # the next views bring it again
        return fit

    def correct_again(self, usable: UsableViews, why: str, wide: NDArray[np.int64] = _NONE) -> None:
        """Recompute line integrals with all references and air columns, replacing those that the model was fitted to.

        Does nothing if all projections belong to one part, references and air columns are unchanged, no object is in
        the beam of all projections, and no `wide` (laterally offset) projections join them. `why` is reported, unless
        projections are removed from the fit.

        Some of these projections may have become unusable, because a check flagged them after later projections
        arrived, or because the scan took them again. The fit then continues without them, with the initial learning
        rates.
        """
        assert self._correction is not None and self._fit is not None
        fed = self._cursor.view_ids
        kept = np.flatnonzero(np.isin(fed, usable.frames))
        frames = fed[kept]
        gone = fed.size - frames.size
        shaded = self._correction.finds_shadow(frames)
        if not (gone or shaded or wide.size or self._correction.outdated or self.source.table.part_starts.size > 1):
            return
        if shaded:
            why = _SHADED
        if gone:
            why = (
                f"The fit continues without {count(gone, 'projection')} that it had used and that the monitor flagged "
                "later or the scan took again"
            )
        self._sink(StateEntered("correcting", why, time=self._clock.now()))
        self._cursor = replace(self._cursor, batches=())  # not both in memory
        self._correction = self._correction.renewed(every := np.union1d(frames, wide))
        again = self._correction.at_once(every)
        self._cursor = replace(self._cursor, batches=(again,))
        ordinary = again.measured[~np.isin(again.view_ids, wide)] if wide.size else again.measured
        self._fit.replace_views(ordinary, kept if gone else None)

    def advance(self, seconds: float) -> bool:
        """Fit for a while; returns False if there is nothing to fit yet."""
        if self._fit is None:
            return False
        progress = self._fit.advance(seconds)
        if not self._fit.started:
            return False
        self._say(progress)
        return True

    def _say(self, progress: Progress) -> None:
        # A fit that begins anew counts from its own beginning; the history has one time, that of the snapshots.
        progress = replace(progress, seconds=self._clock.now() - self._begin)
        self._history.append(progress)
        self._tell_progress(progress)
        self._say_if_behind(progress)

    def _say_if_behind(self, progress: Progress) -> None:
        """Say once that the fit does not keep up with the views."""
        if self._said_behind or progress.n_views <= BATCH_VIEWS or progress.step >= _BEHIND * progress.n_views:
            return
        self._said_behind = True
        message = (
            f"Nothing to do: the live fit is slower than the scan ({count(progress.step, 'fitting step')} for "
            f"{progress.n_views} projections so far; {count(self.waiting, 'projection')} waiting). FBP is shown "
            "whenever it matches held-out projections better. After the scan, the final fit makes up the missing steps"
        )
        self._sink(StateEntered("behind", message, time=self._clock.now()))

    def measure_law(self) -> None:
        """Once a pass of projections is corrected, measure and report the law of the error."""
        self._laws.look(self._cursor, self.axis_col, self._correction)

    def draw_slices(self, pause: float | None = None) -> None:
        """Draw slices of the projections so far, if there are new projections and `pause` s have passed (None: now).

        Before the axis is known, the middle of the detector is used as axis.
        """
        if self.state is FollowState.WAITS_FOR_AXIS and self._correction is not None:
            self._slices.draw_about_middle(self._correction.renewed, pause)
        elif self.state is FollowState.FEEDS:
            newest = () if self._cursor.newest is None else (self._cursor.newest,)
            self._slices.draw((*self._cursor.batches, *newest), self.axis_col, pause)

    def write_snapshot(self) -> None:
        """Write the current volume and its picture, replacing the last ones."""
        assert self._fit is not None
        self.snapshots.write(self._fit, float(self.axis_col or 0.0))

    def prepared(self) -> PreparedProjections:
        """All projections with their final correction, as the model was fitted to them, and the laterally offset
        projections. No projection is added afterwards.

        Raises:
            DataError: fewer than two projections of the scan can be used.
        """
        self._scan = self._scan.renewed()
        usable = checked_views(self._scan, self._selection, self._warn)
        assert self._correction is not None and self.axis_col is not None  # two views are there, and settled the axis
        self.state = FollowState.ENDED
        self._settle_newest()  # the scan was stopped: no other view comes
        if usable.jumps.size:
            self._warn(
                f"The sample jumped at {frames_text(usable.jumps)}. The live volume does not correct for it. After the "
                "scan, run `beamline recon` on the file: it uses the longer part of the scan, before or after the jump."
            )
        wide = self.source.table.offset_views
        parts = self.source.table.part_starts.size
        why = _SEVERAL_PARTS if parts > 1 else _OUTDATED if self._correction.outdated else _OFFSET
        self.correct_again(usable, why, wide)
        return self._prepared(self.axis_col, usable)

    def final_fit(self, seconds: float, snapshot_every: float) -> FinalFit:
        """The final fit, to be run on the prepared projections: one pass over all of them, then the refinement of the
        voxel volume, with snapshots."""
        assert self._fit is not None
        last = self._clock.now()

        def look(progress: Progress) -> None:
            nonlocal last
            if self._clock.now() - last >= snapshot_every:
                self.write_snapshot()
                last = self._clock.now()

        message = (
            f"Final fit: {self._fit.last_steps} steps over all {count(self._fit.n_views, 'projection')}, then "
            f"refinement of the voxel volume; at most {seconds:g} s. Ctrl-C keeps the volume reached so far"
        )
        self._sink(StateEntered("finishing", message, time=last))
        return FinalFit(self._fit, self._options.streaming, seconds, self._begin, tuple(self._history), look)

    def _joined(self) -> Projections:
        """The line integrals of all views taken, in one piece."""
        batches = list(self._cursor.batches)
        if len(batches) > 1:
            self._cursor = replace(self._cursor, batches=())  # each is freed when it has been copied
            self._cursor = replace(self._cursor, batches=(merge_and_empty(batches),))
        return self._cursor.batches[0]

    def _prepared(self, axis_col: float, usable: UsableViews) -> PreparedProjections:
        """All views, once recorded, after the steps that need all of them."""
        assert self._correction is not None and self._fit is not None
        selection, projections = self._selection, self._joined()
        places = ViewGeometry(self._scan, selection, axis_col)
        geometry, axis = places.of(projections.view_ids), (axis_col, self._axis.estimate)
        compare_with_flats(self._scan, selection, projections, self._warn, refused=False)
        prepared = assemble(self._scan, selection, projections, geometry, axis, usable, self._warn)
        done = {**self._correction.plan.done, **places.done}
        for step in in_order(selection):
            if isinstance(step, PlaceStep):
                done[step.name] = StepDone(parameters={})  # views are taken as if the sample had not moved
            if isinstance(step, ScanStep):
                try:
                    angles = self.source.table.angles[projections.view_ids]
                    done[step.name] = step.apply(prepared, angles, lambda n, of: None)
                except DataError as error:  # not a reason to discard the volume
                    self._warn(str(error))
                    continue
                if done[step.name].sentence:
                    self._tell({step.name: done[step.name]})
                    self._fit.replace_views(prepared.centred.projections.measured)
        return replace(prepared, done=done)

    def _tell(self, done: Mapping[str, StepDone]) -> None:
        """Say what steps did."""
        corrections_done({name: each.sentence for name, each in done.items()}, self._sink, self._clock)
