"""Finished views: the source of views of a scan that has ended, or is taken as it is."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace

from beamline.core.events import ReconStarted, StateEntered
from beamline.core.stop import never_stopped
from beamline.projections.held_out import hold_out
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.error_bars import refuse_views
from beamline.reconstruct.in_time import fit_within
from beamline.reconstruct.job import Channels, Job, compile_kernels
from beamline.reconstruct.options import ReconOptions
from beamline.reconstruct.outcome import facts_of
from beamline.reconstruct.plan import ReconPlan
from beamline.reconstruct.progress import corrections_done
from beamline.reconstruct.region import Region, locate
from beamline.reconstruct.remarks import partly_seen_warning
from beamline.reconstruct.slab_run import keeping
from beamline.reconstruct.slabs import prepare_within
from recon.base.method import BoundedMethod
from recon.base.stop import Stop

_HELD_OUT_ONE_IN = 10  # one of so many views is held out for --early-stop


@contextmanager
def finished_views(options: ReconOptions, channels: Channels) -> Iterator[Job]:
    """The job of a scan whose views are all there, with compiled kernels; slabs stay where the block fails.

    Raises:
        ConfigError, DataError: the views, the memory or the disk do not suffice.
    """
    sink, clock, warn, phases = channels.sink, channels.clock, channels.warn, channels.phases
    phases.enter("opening the scan")
    with options.source.open() as source:
        facts, options = facts_of(source), options.around_region(source)
        box = options.region if isinstance(options.region, Region) else None
        if box is not None and box.reason:
            sink(StateEntered("roi", box.reason, time=clock.now()))
        prepared, plan = prepare_within(source, options, sink, clock, warn, phases)
    prepared = _for_method(options, prepared, plan, channels)
    _announce(options, prepared, channels)
    if few := partly_seen_warning(prepared.geometry):
        warn(few)
    region = None if box is None else locate(box, options.selection, prepared.geometry)
    # A direct method and a slab have no volume so far: a signal interrupts them.
    stopping = never_stopped if options.method.traits.direct or plan.slabs else channels.stop_scope
    with keeping(options.partial_path) if plan.slabs else nullcontext():
        phases.enter("compiling kernels")
        compile_kernels(options, prepared.geometry, sink, clock)
        phases.enter("reconstruction")
        before_report = Stop()
        if isinstance(options.method, BoundedMethod) and options.method.seconds is not None:
            started = channels.started, channels.worked
            method, before_report = fit_within(options.method, prepared, options.target, started, clock, warn)
            options = replace(options, method=method)
        yield Job(
            options,
            channels,
            prepared,
            lambda: facts,
            stopping,
            slabs=plan.slabs,
            region=region,
            leaves=before_report.leaves,
        )


def _for_method(
    options: ReconOptions, prepared: PreparedProjections, plan: ReconPlan, channels: Channels
) -> PreparedProjections:
    """The views as the method takes them, with some held out where it ends early, after their disk was looked at.

    Raises:
        ConfigError, DataError: the views do not suffice, or the disk does not.
    """
    if options.uncertainty:
        refuse_views(options.method_for(prepared.geometry), prepared.geometry)
    if options.cluster is not None and not plan.slabs:
        channels.warn(
            "The volume fits into the memory and is made here, without --cluster; a smaller --memory makes slabs."
        )
    if options.stops_early and prepared.held_out is None:
        prepared = hold_out(prepared, _HELD_OUT_ONE_IN, advice="leave out --early-stop")
        n = prepared.projections.view_ids.size
        message = f"{prepared.n_projections - n} of {prepared.n_projections} views are held out to say when to stop"
        channels.sink(StateEntered("held_out", message, time=channels.clock.now()))
    options.target.require_room(plan.output, plan.scratch)
    return prepared


def _announce(options: ReconOptions, prepared: PreparedProjections, channels: Channels) -> None:
    """Report the requested corrections of the views, then send the event `recon_started`."""
    sink, clock = channels.sink, channels.clock
    corrections_done({name: done.sentence for name, done in prepared.done.items() if not done.warned}, sink, clock)
    views, confident = prepared.geometry, None if prepared.axis is None else prepared.axis.confident
    more = {"n_projections": prepared.n_projections, "detector": views.detector_shape, "axis_confident": confident}
    sink(
        ReconStarted(
            options.source.path, options.method.name, views.n_views, prepared.axis_col, more=more, time=clock.now()
        )
    )
