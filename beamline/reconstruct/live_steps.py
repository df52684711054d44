"""Steps of the live fit: functions that compute the next state from the new frames of a growing file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from beamline.core.recon_events import ReconStarted
from beamline.core.text import count
from beamline.projections.correction import NO_VIEWS, apply, survey
from beamline.projections.growing import FedCorrection, feed, ignores_shadow, newest_lines, outdated
from beamline.projections.selection import SelectedScan, check_axis
from beamline.projections.usable_views import UsableViews
from beamline.projections.views import refuse
from beamline.reconstruct.followed_views import AxisSearch
from beamline.reconstruct.live_states import Cursor, Feeds, Following, LiveScan, WaitsForAxis, WaitsForReferences
from beamline.storage.rules.scan import BEFORE_VIEWS, findings_of
from recon.base.method import Progress
from recon.prep.projections import Projections, merge_and_empty
from recon.splatting.stream import StreamingFit

_ONE_VIEW = np.zeros(1)  # rad
BATCH_VIEWS = 32  # number of projections that are corrected before the fit continues
# steps per projection; below this, FBP matches the projections better (tests/bench/test_live_accuracy.py)
_BEHIND = 0.5
_AXIS_MOVES = 1.0  # px; a larger change of the axis restarts the fit

# Reasons to correct all projections again.
_NEXT_PART = (
    "Correcting all projections again, because the next part of the run starts: each projection is corrected "
    "with the flats of its own part"
)
_SHADED = (
    "Correcting all projections again, because an object is in the beam in all projections, but not in the flats: "
    "rays through this object are no longer used"
)


def first_state(live: LiveScan) -> WaitsForReferences:
    """The state before any frame is read."""
    stated = live.selection.axis_col
    return WaitsForReferences(live.views.scan, live.source.axis_col if stated is None else stated)


def next_state(live: LiveScan, state: Following, file: Cursor) -> tuple[Following, Cursor]:
    """Go through the states as far as the projections of the file allow, and feed the fit with one batch.

    Returns:
        The next state, and the cursor after the projections that were taken.

    Raises:
        ConfigError, DataError: the scan has no references or no axis and will not get them, or projections cannot be
            corrected.
    """
    if isinstance(state, WaitsForReferences):
        state = with_references(live, state, file.ended)
    if isinstance(state, WaitsForAxis):
        state = with_axis(live, state, file)
    elif isinstance(state, Feeds) and not state.search.settled:
        state = with_better_axis(live, state, file)
    return fed(live, state, file) if isinstance(state, Feeds) else (state, file)


def with_references(live: LiveScan, state: WaitsForReferences, ended: bool) -> Following:
    """The correction begins if darks and flats can be used.

    If darks or flats come after the projections, they are complete only when the scan has ended.

    Raises:
        DataError: the correction cannot begin, and no later frame can change this.
    """
    scan = state.scan.renewed()
    blockers = findings_of(scan.evidence, BEFORE_VIEWS)
    if not ended and (state.come_last or any(finding.rule == "references" for finding in blockers)):
        if not state.come_last:
            live.enter(
                "waiting",
                "No live volume during this scan, because no darks or no flats were taken before the projections. "
                "The reconstruction starts after the scan",
            )
        return replace(state, scan=scan, come_last=True)
    refuse(live.source, blockers)
    correction = new_correction(live, scan)
    live.tell_done(correction.plan.done)
    if state.axis_col is None:
        return WaitsForAxis(correction, AxisSearch())
    return _begun(live, correction, state.axis_col, AxisSearch(settled=True))


def with_axis(live: LiveScan, state: WaitsForAxis, file: Cursor) -> WaitsForAxis | Feeds:
    """The fit begins if the projections show the axis.

    Raises:
        DataError: the scan has ended, and no axis is found.
    """
    search, axis_col = state.search.look(live.views, state.correction.plan, file.views, None, file.ended, live.warn)
    if axis_col is None:
        return replace(state, search=search)
    return _begun(live, state.correction, axis_col, search)


def with_better_axis(live: LiveScan, state: Feeds, file: Cursor) -> Feeds:
    """After a large change of the axis the fit begins again with all projections; after a small change it continues."""
    before = state.axis_col
    search, axis_col = state.search.look(live.views, state.correction.plan, file.views, before, file.ended, live.warn)
    if axis_col is None or axis_col == before:
        return replace(state, search=search)
    if abs(axis_col - before) <= _AXIS_MOVES:
        state.fit.move_axis(live.selection.geometry(axis_col, _ONE_VIEW).axis_col)
        return replace(state, search=search, axis_col=axis_col)
    state.fit.clear()  # free the memory of the old fit before the new fit is made
    fit = _new_fit(live, axis_col, again=bool(state.history))
    for batch in state.batches:
        fit.add_views(batch.measured, live.views.angles(axis_col, batch.view_ids))
    # the next views correct the newest projection again
    return replace(state, search=search, axis_col=axis_col, fit=fit, newest=None)


def new_correction(live: LiveScan, scan: SelectedScan, views: NDArray[np.int64] = NO_VIEWS) -> FedCorrection:
    """A correction with the references of `scan`. It has not corrected any projection yet. For `views` see `survey`."""
    plan = survey(scan, views)
    for sentence in plan.warnings:
        live.warn(sentence)
    return FedCorrection(plan)


def corrected_alone(live: LiveScan, state: WaitsForAxis, frames: NDArray[np.int64]) -> Projections:
    """Line integrals of frames, corrected with all references recorded so far. The fit does not get them."""
    return apply(new_correction(live, state.correction.plan.scan.renewed()).plan, frames, warn=live.warn)


def _begun(live: LiveScan, correction: FedCorrection, axis_col: float, search: AxisSearch) -> Feeds:
    return Feeds(correction, axis_col, search, _new_fit(live, axis_col, again=False))


def _new_fit(live: LiveScan, axis_col: float, again: bool) -> StreamingFit:
    """A fit without projections.

    Raises:
        ConfigError: the axis lies outside the detector.
    """
    check_axis(live.source, axis_col)
    method, now = live.method, live.clock.now()
    live.sink(ReconStarted(live.source.path, method.name, live.views.n, axis_col, again, time=now))
    return method.stream(live.selection.geometry(axis_col, _ONE_VIEW), live.seed, live.clock.now)


def fed(live: LiveScan, state: Feeds, file: Cursor) -> tuple[Feeds, Cursor]:
    """Feed the fit with the next projections. They all belong to one part of the file, because each part has its own
    references.
    """
    new = file.new
    parts = np.searchsorted(live.source.table.part_starts, new, "right") - 1
    if new.size and parts[0] != state.part:
        state = _in_part(live, state, int(parts[0]))
    batch = new[parts == parts[:1]][:BATCH_VIEWS]
    all_taken = batch.size == new.size
    state = _with_frames(live, state, batch, last=file.ended and all_taken)
    return state, replace(file, taken=file.frames if all_taken else int(batch[-1]) + 1)


def _in_part(live: LiveScan, state: Feeds, part: int) -> Feeds:
    """Begin a later part of the file, whose projections are corrected with their own references. The last projection of
    the part before waited for the next projection. Now its correction becomes final, and the fit learns all projections
    again.
    """
    state = settled(live, replace(state, part=part))
    if state.batches:
        return corrected_again(live, state, live.views.usable(), _NEXT_PART)
    return replace(state, correction=new_correction(live, state.correction.plan.scan.renewed()))


def settled(live: LiveScan, state: Feeds) -> Feeds:
    """Make the correction of the newest projection final, because the projection for which it waits does not come."""
    return state if state.newest is None else _with_frames(live, state, NO_VIEWS, last=True)


def _with_frames(live: LiveScan, state: Feeds, frames: NDArray[np.int64], last: bool) -> Feeds:
    """Correct frames and feed the fit with them. The fit also gets the newest frame, although its correction waits for
    the next frame.
    """
    newest = state.newest
    batch, correction = feed(state.correction, frames, last=last, warn=live.warn)
    if batch is not None:
        data, views = batch.measured, batch.view_ids
        if newest is not None:
            if not np.array_equal(data[0], newest.measured[0], equal_nan=True):
                state.fit.replace_newest(data[0])
            data, views, newest = data[1:], views[1:], None
        state.batches.append(batch)
        if views.size:
            state.fit.add_views(data, live.views.angles(state.axis_col, views))
    if newest is None and (newest := newest_lines(correction)) is not None:
        state.fit.add_views(newest.measured, live.views.angles(state.axis_col, newest.view_ids))
    return replace(state, correction=correction, newest=newest)


def corrected_again(
    live: LiveScan, state: Feeds, usable: UsableViews, why: str, wide: NDArray[np.int64] = NO_VIEWS
) -> Feeds:
    """Recompute line integrals with all references and air columns. They replace the line integrals to which the model
    was fitted.

    The function does nothing if all projections belong to one part, references and air columns are unchanged, no object
    is in the beam of all projections, and there are no `wide` (laterally offset) projections. `why` is reported, unless
    projections are removed from the fit.

    Some of these projections may have become unusable, because a check flagged them after later projections
    arrived, or because the scan took them again. The fit then continues without them, with the initial learning
    rates.
    """
    correction, source = state.correction, live.source
    ids = np.concatenate([batch.view_ids for batch in state.batches])
    usable_indices = np.flatnonzero(np.isin(ids, usable.frames))
    frames = ids[usable_indices]
    n_lost = ids.size - frames.size
    shaded = ignores_shadow(correction, frames)
    if not (n_lost or shaded or wide.size or outdated(correction) or source.table.part_starts.size > 1):
        return state
    if shaded:
        why = _SHADED
    if n_lost:
        why = (
            f"The fit continues without {count(n_lost, 'projection')} that the monitor has flagged meanwhile, or that "
            "the scan has taken again"
        )
    live.enter("correcting", why)
    state.batches.clear()  # free the memory of the old line integrals first
    correction = new_correction(live, correction.plan.scan.renewed(), all_frames := np.union1d(frames, wide))
    corrected = apply(correction.plan, all_frames, warn=live.warn)
    state.batches.append(corrected)
    ordinary = corrected.measured[~np.isin(corrected.view_ids, wide)] if wide.size else corrected.measured
    state.fit.replace_views(ordinary, usable_indices if n_lost else None)
    return replace(state, correction=correction)


def joined(state: Feeds) -> Projections:
    """The line integrals of `batches` in one piece; they become one batch."""
    if len(state.batches) > 1:
        state.batches[:] = [merge_and_empty(state.batches)]  # each batch is freed when it has been copied
    return state.batches[0]


def after_progress(live: LiveScan, state: Feeds, progress: Progress, waiting: int) -> Feeds:
    """The state with this progress in its history; reports once if the fit does not keep up with the projections.

    Args:
        waiting: number of projections that the fit has not used yet.
    """
    state = replace(state, history=(*state.history, progress))
    if state.told_behind or progress.n_views <= BATCH_VIEWS or progress.step >= _BEHIND * progress.n_views:
        return state
    live.enter(
        "behind",
        f"Nothing to do: the live fit is slower than the scan ({count(progress.step, 'fitting step')} for "
        f"{progress.n_views} projections so far; {count(waiting, 'projection')} waiting). FBP is shown "
        "whenever it matches held-out projections better. After the scan, the final fit makes up the missing steps",
    )
    return replace(state, told_behind=True)
