"""Snapshots: the file of the live volume, and the picture of the volume and of FBP slices; each is replaced in one
step.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.events import Sink
from beamline.core.files import write_whole
from beamline.core.recon_events import SlicesDrawn, SnapshotWritten
from beamline.core.sinks import Warnings
from beamline.plan.plan import one_way
from beamline.reconstruct.followed_views import FollowedViews
from beamline.reconstruct.options import OutputPaths
from beamline.report.live_picture import PictureRow, live_picture, slice_panels, volume_rows
from beamline.storage.recon_record import ReconRecord
from beamline.storage.writers.recon_file import write_reconstruction
from drivers.base.clock import Clock
from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.views import spread
from recon.base.volume import Volume
from recon.prep.projections import Projections
from recon.splatting.anytime import BetterVolume
from recon.splatting.stream import StreamingFit
from recon.voxels.direct import Fbp
from recon.voxels.slices import OrthogonalSlices, orthogonal_slices
from recon.voxels.view_weights import Wedge, unseen_wedges


class Snapshots:
    """The files `<output>.snapshot.h5` and `<output>.live.png` of a followed scan."""

    def __init__(self, target: OutputPaths, views: FollowedViews, sink: Sink, clock: Clock, warn: Warnings) -> None:
        self._source, self._sink, self._clock, self._warn = views.source, sink, clock, warn
        self._begin = clock.now()
        self._sample = str(views.source.attributes.get("sample", "not stated"))
        output = target.output
        self.path: Path = output.with_name(f"{output.stem}.snapshot.h5")
        self.picture_path = target.live_picture
        self.drawn = False  # True if the picture is of this scan
        self._slices: tuple[PictureRow, ...] = ()  # last drawn rows of the picture: FBP slices, and the volume
        self._grown: tuple[PictureRow, ...] = ()
        self._centre: Sequence[float] | None = None  # z, y and x of the FBP slices, at which the volume is also shown
        self._unseen: Wedge | None = None  # missing wedge of the projections of these slices
        self.unit = "mm" if views.scan.selection.pixel_size_mm else "px"

    def write(self, method_of_fit: str, fit: StreamingFit, axis_col: float) -> None:
        """Write the current volume and its picture, which replace the last ones."""
        shown = fit.best_preview()
        (method, errors), unseen = _method(method_of_fit, shown), self._unseen
        record = ReconRecord(
            volume=shown.volume,
            length_unit=self.unit,
            raw_file=str(self._source.path.resolve()),
            title=f"Snapshot from {fit.n_views} projections",
            sample=self._sample,
            time=self._clock.now(),
            parameters={
                "axis_col": axis_col,
                "n_views": fit.n_views,
                "method": method,
                "chosen_because": _why(errors),
                "unseen_deg": np.array(
                    [] if unseen is None else np.degrees((unseen.first, unseen.first + unseen.size))
                ),
            },
        )
        try:
            write_reconstruction(self.path, record, replace=True)
            self._grown = self._rows(fit, record.volume, f"{method}, {_why(errors)}")
            self._write_picture()
        except DataError as error:
            # Windows does not replace a file that a viewer has open; the next snapshot will replace it.
            self._warn(f"A snapshot could not be written: {error}")
            return
        now = self._clock.now()
        written = self.path, self.picture_path, fit.n_views, now - self._begin, fit.unlearnt
        self._sink(SnapshotWritten(*written, method, errors or None, time=now))

    def write_slices(
        self,
        slices: OrthogonalSlices,
        n_views: int,
        heading: str,
        unseen: Wedge | None,
        below: PictureRow | None = None,
    ) -> None:
        """Write the picture: these FBP slices, and below them the rows `below`, or the last drawn slices of the volume
        if there are any.
        """
        self._centre, self._unseen = slices.centre, unseen
        panels = slice_panels(slices.images, slices.centre, slices.pixel, self.unit, unseen)
        self._slices = (PictureRow(heading, panels), *([] if below is None else [below]))
        try:
            self._write_picture()
        except DataError as error:
            self._warn(f"A picture could not be written: {error}")
            return
        self._sink(SlicesDrawn(self.picture_path, n_views, math.degrees(slices.covered), time=self._clock.now()))

    def remove(self) -> None:
        """Remove the snapshot after the final volume is written. The live picture stays."""
        with suppress(PermissionError):  # Windows does not remove a file that a viewer has open
            self.path.unlink(missing_ok=True)

    def _rows(self, fit: StreamingFit, volume: Volume, shown: str) -> tuple[PictureRow, ...]:
        elapsed = self._clock.now() - self._begin
        heading = (
            f"{fit.n_views} projections so far, {shown}; {fit.progress().n_gaussians} Gaussians, {elapsed:.0f} s "
            "after the start"
        )
        return volume_rows(volume, *fit.newest_view(), heading, self.unit, (self._centre, self._unseen))

    def _write_picture(self) -> None:
        write_whole(self.picture_path, live_picture((*self._slices, *self._grown)), replace=True)
        self.drawn = True


def _method(fit: str, shown: BetterVolume) -> tuple[str, dict[str, float]]:
    """The method of the volume that is shown. If two methods were compared, also their errors in held-out
    projections.
    """
    of_fit, direct = shown.errors.fit, shown.errors.direct
    errors = {fit: of_fit, Fbp.name: direct} if math.isfinite(direct) else {}
    return Fbp.name if shown.direct else fit, errors


def _why(errors: Mapping[str, float]) -> str:
    """Why the volume of a method is shown, in words."""
    if not errors:
        return "the only volume so far"
    each = ", ".join(f"{name} {error:.3f}" for name, error in errors.items())
    return f"because it matches the held-out projections better (errors: {each})"


# fewest projections for the first slices; number of projections used before the axis is known
FEWEST, _BEFORE_AXIS = 8, 32


class LiveSlices:
    """Draws slices when there are new projections and enough time has passed. Drawing uses at most half of the time.

    Args:
        below: function that makes a further row of the picture from the projections; it returns None if there is no
            such row.
    """

    def __init__(
        self, views: FollowedViews, snapshots: Snapshots, clock: Clock,
        below: Callable[[Sequence[F32], Geometry], PictureRow | None] = lambda views, geometry: None,
    ) -> None:  # fmt: skip
        self._views, self._snapshots, self._clock, self._below = views, snapshots, clock, below
        # the last view that was drawn; the time from which slices may be drawn again
        self._newest, self._next = -1, -math.inf

    def draw(self, parts: Sequence[Projections], axis_col: float | None, pause: float | None, total: int = 0) -> None:
        """Draw slices from corrected projections. `axis_col` is the rotation axis as a column of the file; None: the
        middle of the detector is used as axis. No slices are drawn for a cone beam, or if the projections have a roll,
        a tilt or shifts.

        Args:
            pause: shortest time in s until slices are drawn again; None: draw now.
            total: number of projections so far; 0 if `parts` contains all of them.
        """
        n, begin = sum(part.view_ids.size for part in parts), self._clock.now()
        if n < FEWEST or (pause is not None and begin < self._next) or int(parts[-1].view_ids[-1]) == self._newest:
            return
        ids = np.concatenate([part.view_ids for part in parts])
        col = (self._views.source.shape[1] - 1) / 2 if axis_col is None else axis_col
        geometry, _ = self._views.geometry(col, ids)
        with suppress(ValueError):
            data = [view for part in parts for view in part.data]
            slices = orthogonal_slices(data, geometry)
            count = f"{n} of {total}" if total > n else str(n)
            place = (
                "the detector middle, because the axis is not known yet; a wrong axis turns edges into crescents "
                "(set optics.axis_col or --axis)"
                if axis_col is None
                else f"column {col:.1f}"
            )
            unseen = max(unseen_wedges(geometry), key=lambda wedge: wedge.size, default=None)
            heading = f"FBP of the first {count} projections{_coverage(unseen, geometry.angles)}, axis at {place}"
            row = self._below(data, geometry)
            self._snapshots.write_slices(slices, n, heading, unseen, *([] if row is None else [row]))
        end = self._clock.now()
        self._newest, self._next = int(ids[-1]), end + max(pause or 0.0, end - begin)

    def due(self, views: NDArray[np.int64], pause: float | None) -> bool:
        """Whether `draw` would draw these projections (rows of the file) now. For `pause` see `draw`."""
        early = pause is not None and self._clock.now() < self._next
        return views.size >= FEWEST and not early and int(views[-1]) != self._newest

    def draw_about_middle(self, lines_of: Callable[[NDArray[np.int64]], Projections], pause: float | None) -> None:
        """Draw slices before the axis is known. They are made from some projections that `lines_of` corrects for this
        purpose only; its argument is their rows of the file.
        """
        views = self._views.chosen(self._views.usable().frames)
        if not self.due(views, pause):
            return
        with suppress(DataError):  # for example projections without beam; the scan and the fit continue
            self.draw([lines_of(spread(views, _BEFORE_AXIS))], None, pause, views.size)


def _coverage(unseen: Wedge | None, angles: NDArray[np.float64]) -> str:
    """The words that are added to a heading if the projections do not cover all angles."""
    if unseen is None:
        return ""
    order = "sequential: " if one_way(angles) else ""
    return f", {order}{180 - math.degrees(unseen.size):.0f} of 180 degrees so far"
