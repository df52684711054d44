"""The views of a job: in memory, or on disk where a scan is too large for it and its volume is made in slabs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from beamline.core.errors import ConfigError, DataError
from beamline.core.events import Counted, Sink, StateEntered
from beamline.core.machine_speed import seconds_left
from beamline.core.phases import Phases
from beamline.core.sinks import Warn
from beamline.core.text import size
from beamline.projections.prepare import DiskBuffer, prepare_projections
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.memory import recon_memory_of
from beamline.reconstruct.options import ReconOptions
from beamline.reconstruct.plan import ReconPlan, of_views, planned, refuse_geometry
from beamline.reconstruct.several_scans import SeveralScans, views_of_others, with_as_many_views
from beamline.storage.readers.base import ScanSource
from beamline.storage.scratch import scratch_array
from drivers.base.clock import Clock
from recon.base.arrays import F64, I64
from recon.base.geometry import Geometry

_BATCH = 0.25  # of the memory: views during correction


def prepare_within(
    source: ScanSource, options: ReconOptions, sink: Sink, clock: Clock, warn: Warn, phases: Phases | None = None
) -> tuple[PreparedProjections, ReconPlan]:
    """As `prepare_projections`, and the plan: of a volume in slabs line integrals lie on disk."""
    began, selection = clock.now(), options.selection

    def progress(n: int, total: int) -> None:
        now = clock.now()
        spent = max(now - began, 1e-9)
        sink(Counted("correction", n, total, n / spent, seconds_left(n, total, spent) or 0.0, time=now))

    try:
        needs = recon_memory_of(source, options)
    except (ConfigError, DataError):
        prepare_projections(source, selection, warn)  # faults of the views come first: this says them
        raise
    plan, buffer = planned(source, options, needs), None
    options.target.require_room(plan.output, plan.scratch)
    if plan.slabs:
        sentence = (
            f"All at once would take {size(needs.at_once)}, {size(plan.allowed)} of memory may be used: views and "
            f"volume lie on the disk of the output while it works, {size(needs.line_integrals + needs.volume)}."
        )
        sink(StateEntered("memory", sentence, time=clock.now()))
        batch = max(1, int((_BATCH * plan.allowed - needs.steps.correcting) / needs.view))
        shape = (needs.geometry.n_views, *needs.geometry.detector_shape)
        buffer = DiskBuffer(scratch_array(options.target.output.parent, shape), batch, progress)
    others = views_of_others(options.source, selection)

    def check(geometry: Geometry) -> None:
        refuse_geometry(source, options, plan, with_as_many_views(geometry, geometry.n_views + others))

    if isinstance(options.source, SeveralScans):
        return options.source.prepare(selection, warn, check, phases), plan
    prepared = prepare_projections(source, selection, warn, buffer, check, phases)
    if options.method.traits.in_time:
        prepared = replace(prepared, times=times_of(source, prepared.projections.view_ids, warn))
    return prepared, of_views(source, options, plan, prepared)


def times_of(source: ScanSource, view_ids: I64, warn: Warn) -> F64:
    """[view] s when each of these views was exposed; evenly spaced in the file's order where it states no times."""
    seconds = source.times
    if seconds is not None and np.isfinite(seconds[view_ids]).all():
        return np.asarray(seconds[view_ids], np.float64)
    period = source.attributes.get("period_s", source.attributes.get("exposure_s", 1.0))
    warn(f"The file states no time of each view. Views count as evenly spaced, {period} s apart, in the file's order.")
    return np.asarray(view_ids * float(period), np.float64)
