"""Plan: plans memory, disk space and slabs of a reconstruction, and raises an error if memory or disk space is not
enough. The run follows the same plan that the dry run states.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from beamline.core.durations import Phases
from beamline.core.errors import DataError
from beamline.core.events import Sink, StateEntered
from beamline.core.machine import Need
from beamline.core.sinks import Warn
from beamline.core.text import size
from beamline.projections.corrections.resampling import TiltAndLens
from beamline.projections.prepare import HELD_OUT_VIEWS, DiskBuffer, prepare_projections, require_usable
from beamline.projections.prepared import PreparedProjections
from beamline.projections.selection import SelectedScan, Selection
from beamline.reconstruct.memory import (
    ReconMemory,
    allowed_memory,
    recon_memory_of,
    refuse_several,
    refuse_smallest,
    refuse_whole,
)
from beamline.reconstruct.options import ReconOptions
from beamline.reconstruct.region import AroundSample, Region, locate
from beamline.reconstruct.run import refuse_views
from beamline.storage.disk_file import scratch_array
from beamline.storage.readers.base import ScanSource
from beamline.storage.writers.partial_volume import slabs_of_partial
from drivers.base.clock import Clock
from recon.base.arrays import F64, I64
from recon.base.geometry import Geometry
from recon.base.method import Method
from recon.base.slabs import Slab, slabs_of
from recon.base.volume import Grid
from recon.voxels.beyond_field import whole_reach

_BATCH = 0.25  # fraction of the memory for projections during correction


@dataclass(frozen=True, kw_only=True)
class ReconPlan(Need):
    """How a reconstruction uses memory and disk.

    Attributes:
        needs: memory needs, as far as they are known so far.
        allowed: bytes of memory that may be used.
        slabs: the slabs in which the volume is reconstructed; empty: in one piece.
        missing: slabs that a partial volume does not have yet; all slabs if there is no partial volume.
    """

    needs: ReconMemory
    allowed: int
    slabs: Sequence[Slab]
    missing: Sequence[Slab]

    @property
    def line_integrals(self) -> int:
        """Bytes of the line integrals on disk."""
        return self.needs.line_integrals if self.slabs else 0


def planned(scan: SelectedScan, options: ReconOptions, needs: ReconMemory) -> ReconPlan:
    """The plan before any frame is read.

    Args:
        needs: result of `recon_memory_of`.

    Raises:
        ConfigError: an option needs more memory than may be used.
        DataError: the smallest slab does not fit, a cone-beam volume does not fit in one piece, or there are slabs of
            an earlier call.
    """
    allowed, at_once = allowed_memory(options.memory, options.cluster), needs.at_once
    source, selection = scan.source, scan.selection
    _refuse_views(source.path, needs.method, needs.geometry, bars=needs.bars)
    if selection.axis_col is not None or source.axis_col is not None or needs.geometry.is_cone:
        _refuse_region(options.region, selection, needs.geometry)
    if at_once <= allowed and options.partial is None:
        return _plan(options, needs, allowed)
    if options.partial is None:
        options.target.refuse_partial()
    if needs.method.volumes == 1 and selection.cone is not None:
        raise DataError(
            f"{source.path}: {needs.method.name} would need {size(at_once)} of memory, but {size(allowed)} is "
            "allowed, and a cone-beam volume cannot be made in slabs. Use more --memory, --bin 2, or fewer --rows."
        )
    refuse_several(needs, allowed)
    refuse_whole(scan, needs, allowed, checkpoints=options.checkpoints.wanted)
    turned = selection.step(TiltAndLens).of(scan) is not None
    # whether other weights are needed is not known yet
    needs = replace(needs, weighted=turned and needs.method.weighs)
    return _in_slabs(source, options, needs, allowed)


def of_views(source: ScanSource, options: ReconOptions, plan: ReconPlan, prepared: PreparedProjections) -> ReconPlan:
    """The plan for the projections after they were read.

    Args:
        plan: the plan that was made before the projections were read.

    Raises:
        DataError: the volume does not fit into the memory, because the axis was found near an edge of the detector, or
            the sample extends beyond the field of view, or the rays need weights.
    """
    geometry = prepared.geometry
    method, shares = options.method, prepared.sources.region_weights
    differ = not plan.slabs or prepared.views.weights is not None or prepared.sources.region_weights_of is not None
    weighted, reach = differ if method.weighs else shares is not None, prepared.lines.reach
    needs = ReconMemory(
        options.method_for(geometry), geometry, 0, weighted, bars=options.uncertainty,
        reach=reach if method.knows_outside else None,
        # the weights of parts of views, and those of all rays
        weights=0 if shares is None else shares.nbytes * (1 + (not plan.slabs)),
    )  # fmt: skip
    more = "The sample extends beyond the field of view" if needs.reach is not None and needs.reach.is_outside else ""
    more = more or "Some pixels have no data, so each ray needs a weight" * bool(needs.weights)
    if geometry.is_cone and more and needs.at_once > plan.allowed:
        raise DataError(
            f"{source.path}: not enough memory. {more}, and the {needs.method.name} volume needs "
            f"{size(needs.at_once)}, but {size(plan.allowed)} is allowed. A cone-beam volume cannot be made in slabs. "
            "Use more --memory, --bin 2, or fewer --rows. Nothing was written."
        )
    if plan.slabs or (more and method.volumes == 1 and needs.at_once > plan.allowed):
        return _in_slabs(source, options, needs, plan.allowed)
    axis_col = prepared.origin.axis_col
    if not geometry.is_cone and prepared.origin.axis is not None and needs.at_once > plan.allowed:
        raise DataError(
            f"{source.path}: not enough memory. The rotation axis (column {axis_col:.2f}) is off the detector "
            f"middle, so the volume of the 360° scan needs {size(needs.at_once)}, but {size(plan.allowed)} is allowed. "
            f"Add --axis {axis_col:.2f}: the volume is then reconstructed in slabs. Nothing was written."
        )
    return _plan(options, needs, plan.allowed)


def refuse_geometry(
    scan: SelectedScan, region: Region | AroundSample | None, plan: ReconPlan, geometry: Geometry
) -> None:
    """Raise DataError or ConfigError if the geometry of all projections, with the known axis, does not allow the
    reconstruction.
    """
    method = plan.needs.method
    _refuse_views(scan.source.path, method, geometry, bars=plan.needs.bars)
    _refuse_region(region, scan.selection, geometry)
    refuse_several(ReconMemory(method, geometry, 0, True), plan.allowed)
    if plan.slabs and not geometry.is_straight:
        raise DataError(
            f"{scan.source.path}: use more --memory, --bin 2, or fewer --rows. The whole scan must be in memory, "
            "because its projections are rolled or tilted, and a volume in slabs needs slices that are aligned with "
            "the detector rows."
        )


def _refuse_views(path: Path, method: Method, geometry: Geometry, *, bars: bool) -> None:
    """Raise DataError or ConfigError if there are too few views for the method, or for its error bars."""
    volumes, least = method.volumes, method.least_views
    if volumes * least > geometry.n_views:
        raise DataError(
            f"{path} cannot be reconstructed by {method.name}: {volumes} volumes from {geometry.n_views} projections "
            f"are too many, because each volume needs at least {least} projections. Nothing was written."
        )
    if bars:
        refuse_views(method, geometry)


def _refuse_region(region: Region | AroundSample | None, selection: Selection, geometry: Geometry) -> None:
    """Raise ConfigError if the region lies outside the volume."""
    if isinstance(region, Region):
        locate(region, selection, geometry)


def _in_slabs(source: ScanSource, options: ReconOptions, needs: ReconMemory, allowed: int) -> ReconPlan:
    """The slabs of the partial volume if there is one, otherwise slabs for which the memory suffices."""
    refuse_smallest(source, needs, allowed, options.selection.binning)
    slices, partial = Grid.matching(needs.geometry).shape[0], options.partial
    if partial is None:
        slabs = slabs_of(slices, needs.height(allowed), needs.method.halo)
        return _plan(options, needs, allowed, slabs, slabs)
    slabs, missing = slabs_of_partial(partial)
    if slabs[-1].own.stop != slices:
        stored_slices = slabs[-1].own.stop
        raise DataError(
            f"{partial} contains a volume of {stored_slices} slices, but this reconstruction has {slices}. Use the "
            f"options with which {partial} was written, or start again without --resume."
        )
    if (wanted := needs.slab(slabs[0].own.stop)) > allowed:
        needed_mb = math.ceil(wanted / 1e6)
        raise DataError(
            f"The slabs of {partial} need {size(wanted)} of memory, but {size(allowed)} is allowed. Use --memory "
            f"{needed_mb}M if the computer has this much memory. No file was changed."
        )
    return _plan(options, needs, allowed, slabs, missing)


def _plan(
    options: ReconOptions,
    needs: ReconMemory,
    allowed: int,
    slabs: Sequence[Slab] = (),
    missing: Sequence[Slab] = (),
) -> ReconPlan:
    output, scratch = options.disk_needs(needs.volume, in_slabs=bool(slabs))
    return ReconPlan(
        memory=max(needs.slab(slabs[0].own.stop), needs.least) if slabs else needs.at_once,
        output=output,
        scratch=scratch + needs.line_integrals * bool(slabs),
        needs=needs,
        allowed=allowed,
        slabs=slabs,
        missing=missing,
    )


def prepare_within(
    scan: SelectedScan, options: ReconOptions, sink: Sink, clock: Clock, warn: Warn, phases: Phases | None = None
) -> tuple[PreparedProjections, ReconPlan]:
    """Call `prepare_projections` and make the plan. If the volume is made in slabs, the line integrals are stored on
    disk.
    """
    require_usable(scan)  # errors of the projections are raised before errors of the options
    needs = recon_memory_of(scan, options)
    plan, buffer = planned(scan, options, needs), None
    options.target.require_room(plan.output, plan.scratch)
    if plan.slabs:
        on_disk = size(needs.line_integrals + needs.volume)
        sentence = (
            f"Working in slabs, because the whole volume would need {size(needs.at_once)} of memory and "
            f"{size(plan.allowed)} is allowed. Temporary files on the disk of the output take {on_disk}."
        )
        sink(StateEntered("memory", sentence, time=clock.now()))
        batch = max(1, int((_BATCH * plan.allowed - needs.steps.correcting) / needs.view))
        shape = (needs.geometry.n_views + HELD_OUT_VIEWS, *needs.geometry.detector_shape)
        buffer = DiskBuffer(scratch_array(options.target.output.parent, shape), batch)

    prepared = prepare_projections(
        scan, warn, buffer, lambda geometry: refuse_geometry(scan, options.region, plan, geometry), phases
    )
    if "times" in options.method.takes:
        prepared = replace(prepared, times=times_of(scan.source, prepared.ids, warn))
    if options.method.knows_outside:
        reach = whole_reach(prepared.views.seen)
        prepared = replace(prepared, lines=replace(prepared.lines, reach=reach))
    return prepared, of_views(scan.source, options, plan, prepared)


def times_of(source: ScanSource, view_ids: I64, warn: Warn) -> F64:
    """[view] time in s at which each of these projections was exposed; if the file states no times, they are evenly
    spaced in the order of the file."""
    seconds = source.table.times
    if seconds is not None and np.isfinite(seconds[view_ids]).all():
        return np.asarray(seconds[view_ids], np.float64)
    period = source.attributes.get("period_s", source.attributes.get("exposure_s", 1.0))
    warn(
        f"The file states no times. The projections are assumed to be evenly spaced in time, {period} s apart, in the "
        "order of the file."
    )
    return np.asarray(view_ids * float(period), np.float64)
