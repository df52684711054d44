"""End of a followed scan: the last corrections, the prepared projections, and the final fit."""

from __future__ import annotations

from collections.abc import Callable

from beamline.core.errors import DataError
from beamline.core.events import StateEntered
from beamline.core.text import count, frames_text
from beamline.projections.consistency import compare_with_flats
from beamline.projections.growing import outdated
from beamline.projections.prepare import assemble, with_reach
from beamline.projections.prepared import PreparedProjections
from beamline.projections.protocols import PlaceStep, ScanStep
from beamline.projections.registry import in_order
from beamline.projections.selection import SelectedScan
from beamline.projections.step import StepDone
from beamline.projections.usable_views import UsableViews
from beamline.projections.views import ViewGeometry
from beamline.reconstruct.live_states import Feeds, LastFit, LiveScan
from beamline.reconstruct.live_steps import corrected_again, joined, settled
from recon.base.method import Progress
from recon.splatting.time_limit import FinalFit

# Reasons to correct all projections again.
_OUTDATED = (
    "Correcting all projections again, for one of these reasons: new flats or darks arrived, the air columns "
    "changed, or new angles lie between earlier angles (zingers are found by comparing projections at neighbouring "
    "angles)"
)
_SEVERAL_PARTS = "Correcting all projections again at the end of the run, because the run has several parts"
_OFFSET = "Correcting all projections again, now together with the laterally offset projections"


def ended(live: LiveScan, state: Feeds, scan: SelectedScan, usable: UsableViews) -> LastFit:
    """The state at the end of a scan, or of its reading: no projection comes any more.

    Args:
        scan: the scan with all recorded frames.
        usable: the projections of the scan that may be used.

    Raises:
        DataError: fewer than two projections of the scan can be used.
    """
    state = settled(live, state)  # the scan was stopped, so that no other projection comes
    if usable.jumps.size:
        live.warn(
            f"The sample jumped at {frames_text(usable.jumps)}. The live volume does not correct for this jump. "
            "After the scan, run `beamline recon` on the file: `beamline recon` uses the longer part of the scan, "
            "before or after the jump."
        )
    table = live.source.table
    reason = _SEVERAL_PARTS if table.part_starts.size > 1 else _OUTDATED if outdated(state.correction) else _OFFSET
    state = corrected_again(live, state, usable, reason, table.offset_views)
    return LastFit(_prepared(live, state, scan, usable), state.fit, state.axis_col, state.history)


def _prepared(live: LiveScan, state: Feeds, scan: SelectedScan, usable: UsableViews) -> PreparedProjections:
    """All projections, after the correction steps that need all of them."""
    projections, places = joined(state), ViewGeometry(scan, state.axis_col)
    geometry, axis = places.of(projections.view_ids), (state.axis_col, state.search.estimate)
    compare_with_flats(scan, projections, live.warn, refused=False)
    prepared = assemble(scan, projections, geometry, axis, usable, live.warn)
    done = {**state.correction.plan.done, **places.done}
    for step in in_order(scan.selection):
        if isinstance(step, PlaceStep):
            done[step.name] = StepDone(parameters={})  # the sample is assumed not to have moved
        if isinstance(step, ScanStep):
            try:
                angles = live.source.table.angles[projections.view_ids]
                done[step.name] = step.apply(prepared, angles, lambda n, total: None)
            except DataError as error:  # the error is not a reason to discard the volume
                live.warn(str(error))
                continue
            if done[step.name].sentence:
                live.tell_done({step.name: done[step.name]})
                state.fit.replace_views(prepared.centred.with_gaps)
    return with_reach(scan, prepared.stating(done=done))


def final_fit(
    live: LiveScan, last: LastFit, seconds: float, snapshot_every: float, write_snapshot: Callable[[], None]
) -> FinalFit:
    """The final fit, to be run on the prepared projections: one pass over all of them, then the voxel refinement. It
    writes a snapshot every `snapshot_every` s.
    """
    written = live.clock.now()

    def look(progress: Progress) -> None:
        nonlocal written
        if live.clock.now() - written >= snapshot_every:
            write_snapshot()
            written = live.clock.now()

    message = (
        f"Final fit: {last.fit.last_steps} steps over all {count(last.fit.n_views, 'projection')}, then "
        f"refinement of the voxel volume; at most {seconds:g} s. Ctrl-C keeps the volume reached so far"
    )
    live.sink(StateEntered("finishing", message, time=written))
    return FinalFit(last.fit, live.method, seconds, live.begin, last.history, look)
