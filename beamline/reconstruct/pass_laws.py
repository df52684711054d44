"""Pass laws: measures how the error of the volume of a followed scan depends on the number of projections."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from beamline.core.errors import DataError
from beamline.core.events import Sink
from beamline.core.recon_events import LawMeasured
from beamline.core.sinks import Warnings
from beamline.projections.correction import flats_as_projections
from beamline.reconstruct.followed_views import FollowedViews
from beamline.reconstruct.live_states import Cursor, Feeds, Following, WaitsForAxis, WaitsForReferences
from drivers.base.clock import Clock
from recon.voxels.measured_law import measured_law

_NOISE_FLATS = 8  # largest number of flats from which the noise of a frame is measured
_NO_GAIN = "The improvement by further projections is not predicted"


class PassLaws:
    """Measures, for each pass, how the error of the volume depends on the number of projections (the law of the error).
    It measures as soon as all usable projections of the pass are corrected. If the next pass has already ended by then,
    the law of this pass is not measured, because only the newest law is used.
    """

    def __init__(self, views: FollowedViews, seed: int, sink: Sink, clock: Clock, warn: Warnings) -> None:
        self._views, self._sink, self._clock, self._warn = views, sink, clock, warn
        self._rng = np.random.default_rng(seed)
        self._end = 0  # rows of the file up to the end of the newest pass that was looked at

    def look(self, state: Following, file: Cursor) -> None:
        """Measure and report the law at the end of the newest pass, unless this was done already.

        The law is measured on ordinary projections. If there are also laterally offset projections, the density outside
        the field of view is known, and the offset of the law is 0. If no law can be measured, a warning gives the
        reason, and an event has the reason instead of the numbers.
        """
        ends = self._views.source.table.pass_ends
        if not ends.size or (end := int(ends[-1])) == self._end:
            return
        missing = _missing(state, file)
        if (file.frames if missing else file.taken) < end:
            return
        self._end = end
        if missing:  # the scan waits for the law and takes no further frame, so no frame can show what is missing
            self._no_law(ends.size, 0, f"{missing} yet")
            return
        usable = {row for row in self._views.usable().frames.tolist() if row < end}
        images = {
            row: image
            for part in (state.corrected if isinstance(state, Feeds) else ())
            for row, image in zip(part.view_ids.tolist(), part.data, strict=True)
            if row in usable
        }
        rows = np.array([*images], np.int64)
        if not rows.size or not isinstance(state, Feeds):
            self._no_law(ends.size, 0, "none of the projections can be used")
            return
        views_at_ends = [n for n in np.searchsorted(rows, ends).tolist() if n]
        try:
            geometry, _ = self._views.geometry(state.axis_col, rows)
            open_beam = flats_as_projections(state.correction.plan, _NOISE_FLATS)
            error_law, gained = measured_law(
                np.stack([*images.values()]), geometry, views_at_ends, self._rng, open_beam
            )
        except (ValueError, DataError, MemoryError) as error:
            self._no_law(ends.size, rows.size, str(error) or "there is not enough memory")
            return
        if (self._views.source.table.offset_views < end).any() and error_law.offset < 1:
            error_law = replace(error_law, noise=error_law.noise / (1 - error_law.offset), offset=0.0)
        self._warn.withdraw(_NO_GAIN)
        self._sink(LawMeasured(ends.size, **vars(error_law), gained=gained, time=self._clock.now()))

    def _no_law(self, number: int, n_views: int, why: str) -> None:
        self._warn(f"{_NO_GAIN}: {why}.")
        self._sink(
            LawMeasured(number, n_views, math.nan, math.nan, math.nan, math.nan, reason=why, time=self._clock.now())
        )


def _missing(state: Following, file: Cursor) -> str:
    """Why the projections of the file cannot be used; empty if they can."""
    if isinstance(state, WaitsForReferences) and file.behind:
        return "darks or flats have not been taken"
    if isinstance(state, WaitsForAxis) or state.axis_col is None:
        return "the rotation axis is not known"
    return ""
