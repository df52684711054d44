"""The views of a job: in memory, or on disk with the slabs in which a scan too large for it is reconstructed."""

from __future__ import annotations

from collections.abc import Callable
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
from beamline.projections.selection import cone_of
from beamline.reconstruct.memory import (
    ReconMemory,
    memory_of,
    recon_memory_of,
    refuse_few_views,
    refuse_slabs,
    refuse_smallest,
    refuse_whole,
    surely_weighted,
)
from beamline.reconstruct.options import ReconOptions
from beamline.reconstruct.region import Region, locate
from beamline.reconstruct.several_scans import SeveralScans, views_of_others, with_as_many_views
from beamline.storage.readers.base import ScanSource
from beamline.storage.scratch import scratch_array
from beamline.storage.writers.partial_volume import slabs_of_partial
from drivers.base.clock import Clock
from recon.base.arrays import F64, I64
from recon.base.geometry import Geometry
from recon.base.slabs import Slab, slabs_of
from recon.base.volume import Grid

_BATCH = 0.25  # of the memory: views during correction


def disk_buffer_of(
    source: ScanSource, options: ReconOptions, progress: Callable[[int, int], None], warn: Callable[[str], None]
) -> DiskBuffer | None:
    """Where the views go if they do not fit into the memory; None if they fit, or if slabs are impossible.

    Raises:
        DataError: the smallest slab does not fit, or the disk is too full.
        ConfigError: an option needs everything in memory.
    """
    if cone_of(source, options.selection) is not None:
        return None
    try:
        needs = recon_memory_of(source, options)
    except ConfigError:
        return None  # faults of the views come first; reading them reports these
    memory = memory_of(options)
    if needs.at_once <= memory and options.partial is None:
        return None
    if options.partial is None:
        options.target.refuse_partial()
    refuse_whole(source, options, needs, memory)
    refuse_smallest(
        source, replace(needs, weighted=surely_weighted(source, options)), memory, options.selection.binning
    )
    batch = max(1, int((_BATCH * memory - needs.steps.correcting) / needs.view))
    warn(
        f"All at once would take {size(needs.at_once)}, {size(memory)} of memory may be used: views and volume lie on "
        f"the disk of the output while it works, {size(needs.line_integrals + needs.volume)}."
    )
    shape = (needs.geometry.n_views, *needs.geometry.detector_shape)
    return DiskBuffer(scratch_array(options.target.output.parent, shape), batch, progress)


def prepare_within(
    source: ScanSource, options: ReconOptions, sink: Sink, clock: Clock, warn: Warn, phases: Phases | None = None
) -> tuple[PreparedProjections, list[Slab]]:
    """As `prepare_projections`, and the slabs if line integrals lie on disk; none: all at once."""
    began = clock.now()

    def progress(n: int, total: int) -> None:
        now = clock.now()
        spent = max(now - began, 1e-9)
        sink(Counted("correction", n, total, n / spent, seconds_left(n, total, spent) or 0.0, time=now))

    def say(text: str) -> None:
        sink(StateEntered("memory", text, time=clock.now()))

    memory = memory_of(options)
    buffer = disk_buffer_of(source, options, progress, say)

    others = views_of_others(options.source, options.selection)

    def check(geometry: Geometry) -> None:
        if isinstance(options.region, Region):
            locate(options.region, options.selection, geometry)
        if options.method.traits.several:
            needs = ReconMemory(options.method, with_as_many_views(geometry, geometry.n_views + others), 0, True)
            refuse_few_views(source, options, needs.geometry)
            if needs.at_once > memory:
                refuse_whole(source, options, needs, memory)
        if buffer is not None and not geometry.is_straight:
            raise DataError(
                f"{source.path}: its views are rolled or tilted, and a volume in slabs takes rows for slices. "
                "The whole scan has to be in memory: give more --memory, or --bin 2, or fewer --rows."
            )

    if isinstance(options.source, SeveralScans):
        return options.source.prepare(options.selection, warn, check, phases), []
    prepared = prepare_projections(source, options.selection, warn, buffer, check, phases)
    geometry, method = prepared.geometry, options.method_for(prepared.geometry)
    if method.traits.in_time:
        prepared = replace(prepared, times=times_of(source, prepared.projections.view_ids, warn))
    if buffer is None:
        if options.partial is not None:
            raise DataError(f"{options.partial} holds slabs, and {source.path} is a cone, which is not made in slabs.")
        needs = ReconMemory(method, geometry, 0, not method.traits.direct, bars=options.uncertainty)
        _refuse_wider(source, prepared, needs, memory)
        return prepared, []
    weighted = not method.traits.direct and (prepared.ray_factors() is not None or prepared.shares_of is not None)
    needs = ReconMemory(method, geometry, 0, weighted, bars=options.uncertainty)
    refuse_smallest(source, needs, memory, options.selection.binning)
    if options.partial is None:
        return prepared, slabs_of(Grid.matching(geometry).shape[0], needs.height(memory), method.traits.halo)
    slabs, _ = slabs_of_partial(options.partial)
    refuse_slabs(options.partial, slabs, needs, memory)
    return prepared, slabs


def times_of(source: ScanSource, view_ids: I64, warn: Warn) -> F64:
    """[view] s when each of these views was exposed; evenly spaced in the file's order where it states no times."""
    seconds = source.times
    if seconds is not None and np.isfinite(seconds[view_ids]).all():
        return np.asarray(seconds[view_ids], np.float64)
    period = source.attributes.get("period_s", source.attributes.get("exposure_s", 1.0))
    warn(f"The file states no time of each view. Views count as evenly spaced, {period} s apart, in the file's order.")
    return np.asarray(view_ids * float(period), np.float64)


def _refuse_wider(source: ScanSource, prepared: PreparedProjections, needs: ReconMemory, memory: int) -> None:
    """Raises DataError if a volume does not fit after all, because its axis was found near an edge."""
    if needs.geometry.is_cone or prepared.axis is None or needs.at_once <= memory:
        return
    raise DataError(
        f"{source.path}: the rotation axis was found at column {prepared.axis_col:.2f}, off the middle, and the volume "
        f"that a full turn sees takes {size(needs.at_once)} of memory, {size(memory)} may be used. Give "
        f"--axis {prepared.axis_col:.2f}, so that it is made in slabs. Nothing was written."
    )
