"""Estimate of a reconstruction before it begins: memory, time, and bytes on disk."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.need import Need
from beamline.core.text import count, size
from beamline.projections.prepare import require_usable
from beamline.projections.selection import check_axis, cone_of
from beamline.projections.view_geometry import stated_geometry
from beamline.reconstruct.error_bars import refuse_views
from beamline.reconstruct.measure import fit_truth
from beamline.reconstruct.memory import (
    memory_of,
    recon_memory_of,
    refuse_few_views,
    refuse_slabs,
    refuse_smallest,
    refuse_whole,
    surely_weighted,
)
from beamline.reconstruct.options import ReconOptions
from beamline.reconstruct.refusals import refuse_before_reading
from beamline.reconstruct.region import Region, locate
from beamline.reconstruct.several_scans import SeveralScans, views_of_others, with_as_many_views
from beamline.storage.readers.base import ScanSource
from beamline.storage.writers.partial_volume import slabs_of_partial
from recon.assess.time_model import duration_text
from recon.base.geometry import Geometry
from recon.base.method import Method, volumes_of
from recon.base.slabs import Slab, slabs_of
from recon.base.volume import Grid
from recon.base.work import Rates, Span, costs_of, parts_of, seconds_of


@dataclass(frozen=True, kw_only=True)
class Estimate(Need):
    """What a reconstruction will take. Its seconds are without reading and correction; without scratch it is at once.

    Attributes:
        shape: of the volume [z, y, x], or of several volumes [volume, z, y, x].
        at_once: bytes of memory with everything in it.
        allowed: bytes of memory that may be used.
        slabs: that are still to be made.
        done: slices that a partial volume has.
        free: bytes on the disk of the output.
    """

    method: str
    views: int
    shape: tuple[int, ...]
    at_once: int
    allowed: int
    slabs: int
    done: int
    free: int

    def lines(self) -> list[str]:
        in_slabs = f"in {count(self.slabs, 'slab')}; all at once would take {size(self.at_once)}"
        if self.done:
            in_slabs = f"in {count(self.slabs, 'slab')} that are left; {self.done} of {self.shape[0]} slices are there"
        how = in_slabs if self.scratch else "all at once"
        *several, z, y, x = self.shape
        what = f"{'volumes':<10}{several[0]} of " if several else f"{'volume':<10}"
        return [
            f"{what}{z} x {y} x {x} voxels by {self.method}, from {self.views} views",
            f"{'memory':<10}{size(self.memory or 0)} of {size(self.allowed)}, {how}",
            f"{'disk':<10}{size(self.output)} for the result, {size(self.scratch)} meanwhile; {size(self.free)} free",
            f"{'time':<10}{self._time()}",
        ]

    def _time(self) -> str:
        if self.seconds is None or self.least_seconds is None:
            return f"not known: {self.method} does not say what it computes"
        most, least = (f"about {duration_text(seconds)}" for seconds in (self.seconds, self.least_seconds))
        span = f"{most}; {least} where the data end it early" if self.least_seconds < self.seconds else most
        return f"{span}, reading and correction not counted"


def estimate(options: ReconOptions, rates: Rates) -> Estimate:
    """Estimate for a finished scan; for a partial volume, of the missing slabs. Nothing is run. Frames
    are read only to find a region around the sample.

    Args:
        rates: of this machine.

    Raises:
        DataError: it does not fit into the memory or on the disk, with the option that would make it fit. Also for a
            partial volume with another number of slices.
        ConfigError: the selection does not fit the scan, or an option needs more memory than there is.
        All else that the reconstruction refuses before it reads a frame.
    """
    truth = refuse_before_reading(options)
    with options.source.open() as source:
        options = options.around_region(source)
        geometry = _checked_geometry(source, options, truth)
        allowed, needs = memory_of(options), recon_memory_of(source, options)
        shape = Grid.matching(geometry).shape
        slabs = missing = slabs_of(shape[0], shape[0], 0)
        fits = needs.at_once <= allowed and options.partial is None
        if not fits and geometry.is_cone and not options.method.traits.several:
            raise DataError(
                f"{source.path}: {options.method.name} would take {size(needs.at_once)}, {size(allowed)} of memory may "
                "be used, and a cone is not made in slabs. Give more --memory, or --bin 2, or fewer --rows."
            )
        if not fits:
            if options.partial is None:
                options.target.refuse_partial()
            refuse_whole(source, options, needs, allowed)
            needs = replace(needs, weighted=surely_weighted(source, options))
            refuse_smallest(source, needs, allowed, options.selection.binning)
            slabs = missing = slabs_of(shape[0], needs.height(allowed), needs.method.traits.halo)
        if options.partial is not None:
            slabs, missing = slabs_of_partial(options.partial)
            if slabs[-1].own.stop != shape[0]:
                raise DataError(f"{options.partial} is of {slabs[-1].own.stop} slices, this volume has {shape[0]}.")
            refuse_slabs(options.partial, slabs, needs, allowed)
    output, meanwhile = (needs.volume, 0) if fits else options.disk_needs(needs.volume)
    scratch = 0 if fits else needs.line_integrals + meanwhile
    free = _room(options, scratch + output)
    span = _span(options, needs.method, geometry, missing, rates)
    done = sum(slab.own.stop - slab.own.start for slab in slabs) - sum(s.own.stop - s.own.start for s in missing)
    height = slabs[0].own.stop
    of_all = shape if (several := volumes_of(needs.method)) == 1 else (several, *shape)
    return Estimate(
        method=options.method.name,
        views=geometry.n_views,
        shape=of_all,
        at_once=needs.at_once,
        allowed=allowed,
        memory=needs.at_once if fits else max(needs.slab(height), needs.least),
        slabs=len(missing),
        done=done,
        scratch=scratch,
        output=output,
        free=free,
        seconds=None if span is None else span.most,
        least_seconds=None if span is None else span.least,
    )


def _span(
    options: ReconOptions, method: Method, geometry: Geometry, missing: Sequence[Slab], rates: Rates
) -> Span | None:
    """The seconds of these slabs; None where the method does not say what it computes."""
    if not missing:
        return Span(0.0, 0.0)
    heights = [slab.slices.stop - slab.slices.start for slab in missing]
    try:
        costs = costs_of(method, parts_of(geometry, heights), decided=options.partial is not None)
    except ValueError as error:  # as the method itself refuses the views
        raise DataError(f"{options.source.path} cannot be reconstructed by {method.name}: {error}.") from error
    if costs is None:
        return None
    span, times = seconds_of(costs, rates), 1 + options.uncertainty  # error bars take at most as long
    return Span(times * span.least, times * span.most)


def _checked_geometry(source: ScanSource, options: ReconOptions, truth: NDArray[np.float32] | None) -> Geometry:
    """The stated geometry of all views. ConfigError and DataError as the reconstruction, before it reads a frame."""
    scans, selection = options.source, options.selection
    require_usable(source, selection)
    geometry = stated_geometry(source, selection)
    for axis in (selection.axis_col, source.axis_col if cone_of(source, selection) is None else None):
        if axis is not None:
            check_axis(source, axis)
    if isinstance(scans, SeveralScans):
        scans.require_alike(selection)
    geometry = with_as_many_views(geometry, geometry.n_views + views_of_others(scans, selection))
    refuse_few_views(source, options, geometry)
    if isinstance(options.region, Region):
        locate(options.region, selection, geometry)
    if options.uncertainty:
        refuse_views(options.method_for(geometry), geometry)
    if truth is not None:
        fit_truth(truth, Grid.matching(geometry), selection.binning)
    return geometry


def _room(options: ReconOptions, needed: int) -> int:
    """Bytes that the disk of the output has. DataError where that is less than what is needed."""
    folder = options.target.output.parent
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise DataError(
            f"{folder} has {size(free)}, and {size(needed)} are needed. Write with -o to another disk, or give --bin "
            f"{2 * options.selection.binning}."
        )
    return free
