"""Live fit: follows the file of a running scan, and reports the progress, slices and snapshots of its volume.

The live fit drives the state machine of `live_states` and `live_steps`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from beamline.core.errors import DataError
from beamline.projections.views import checked_views
from beamline.reconstruct.followed_views import FollowedViews
from beamline.reconstruct.job import progress_events
from beamline.reconstruct.live_end import ended, final_fit
from beamline.reconstruct.live_states import Cursor, Feeds, Following, LastFit, LiveScan, WaitsForAxis
from beamline.reconstruct.live_steps import after_progress, corrected_alone, first_state, next_state
from beamline.reconstruct.options import OutputPaths
from beamline.reconstruct.pass_laws import PassLaws
from beamline.reconstruct.snapshots import LiveSlices, Snapshots
from beamline.storage.readers.base import ScanSource
from recon.splatting.time_limit import FinalFit

_LEAST_VIEWS = 16  # projections needed for a volume after a stop


class ScanFollower:
    """Follows the file of a running scan and updates the volume. The caller decides when to read the file, when to fit,
    and when to end.

    Attributes:
        state: state of the live fit; only `take_new_frames` and `advance` change it.
        snapshots: the files that show the volume so far.
    """

    def __init__(self, live: LiveScan, target: OutputPaths) -> None:
        self._live, sink, clock = live, live.sink, live.clock
        self.state: Following = first_state(live)
        self._cursor = Cursor()
        self._tell_progress = progress_events(sink, clock, waiting=lambda: self.waiting)
        self._laws = PassLaws(live.views, live.seed, sink, clock, live.warn)
        self.snapshots = Snapshots(target, live.views, sink, clock, live.warn)
        self._slices = LiveSlices(live.views, self.snapshots, clock)

    @property
    def source(self) -> ScanSource:
        """The file of the scan; whoever opened it closes it."""
        return self._live.source

    @property
    def views(self) -> FollowedViews:
        """The projections in the file."""
        return self._live.views

    @property
    def n_views_taken(self) -> int:
        """Number of projections that the fit has used."""
        return self.state.n_views if isinstance(self.state, Feeds) else 0

    @property
    def waiting(self) -> int:
        """Number of projections in the file that the fit has not used yet."""
        return self._cursor.new.size + (self.state.fit.n_unlearnt if isinstance(self.state, Feeds) else 0)

    @property
    def has_volume(self) -> bool:
        """True if the fit has used enough projections to give a volume if it stops now."""
        return isinstance(self.state, Feeds) and self.state.fit.started and self.state.n_views >= _LEAST_VIEWS

    def take_new_frames(self, ended: bool) -> bool:
        """Read the file and feed the fit with at most one batch of new projections. Returns True if the file has
        grown."""
        before, n = self._cursor, self.source.refresh()
        views = self.views.chosen(self.views.usable().frames)
        self._cursor = Cursor(n, views, ended, before.taken if views.size else n)
        if views.size:
            self.state, self._cursor = next_state(self._live, self.state, self._cursor)
        return n > before.frames

    def catch_up(self, should_stop: Callable[[], bool]) -> None:
        """Read the remaining frames of a scan that has ended. After a stop request, read only as many as a volume
        needs.
        """
        while self._cursor.behind:
            if self.n_views_taken >= _LEAST_VIEWS and should_stop():
                self._live.warn(
                    f"Stopped: the volume is reconstructed from the first {self.n_views_taken} of {self.views.n} "
                    "projections."
                )
                return
            self.take_new_frames(ended=True)

    def advance(self, seconds: float) -> bool:
        """Fit for `seconds` s; returns False if there is nothing to fit yet."""
        if not isinstance(self.state, Feeds):
            return False
        progress = self.state.fit.advance(seconds)
        if not self.state.fit.started:
            return False
        # A fit that starts again counts its time from its own start; the history and the snapshots count from one
        # start.
        progress = replace(progress, seconds=self._live.clock.now() - self._live.begin)
        self._tell_progress(progress)
        self.state = after_progress(self._live, self.state, progress, self.waiting)
        return True

    def measure_law(self) -> None:
        """Once a pass of projections is corrected, measure and report the law of the error."""
        self._laws.look(self.state, self._cursor)

    def draw_slices(self, pause: float | None = None) -> None:
        """Draw slices of the projections so far, if there are new projections and `pause` s have passed (None: now).

        Before the axis is known, the middle of the detector is used as axis.
        """
        state = self.state
        if isinstance(state, WaitsForAxis):
            self._slices.draw_about_middle(lambda frames: corrected_alone(self._live, state, frames), pause)
        elif isinstance(state, Feeds):
            self._slices.draw(state.corrected, state.axis_col, pause)

    def write_snapshot(self) -> None:
        """Write the current volume and its picture, which replace the last ones. Nothing is written before the fit has
        begun.
        """
        if isinstance(self.state, Feeds):
            self.snapshots.write(self._live.method.name, self.state.fit, float(self.state.axis_col))

    def end(self) -> LastFit:
        """All projections with their final correction, and the fit to them. No projection is added afterwards.

        Raises:
            DataError: fewer than two projections of the scan can be used.
        """
        live = self._live
        scan = live.views.scan.renewed()
        usable = checked_views(scan, live.warn)
        if not isinstance(self.state, Feeds):
            raise DataError(
                f"There is no live volume: {live.source.path} was finished before the live fit began. The scan has "
                f"{usable.frames.size} usable projections (--views {live.selection.views}). Nothing was written. "
                "Reconstruct the finished scan without --follow, or select other projections with --views."
            )
        return ended(live, self.state, scan, usable)

    def final_fit(self, last: LastFit, seconds: float, snapshot_every: float) -> FinalFit:
        """The final fit of the volume, with snapshots."""

        def write() -> None:
            self.snapshots.write(self._live.method.name, last.fit, float(last.axis_col))

        return final_fit(self._live, last, seconds, snapshot_every, write)
