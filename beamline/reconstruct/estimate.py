"""Estimate of a reconstruction before it begins: memory, time, and bytes on disk."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace

from beamline.core.errors import DataError
from beamline.core.text import count, size
from beamline.projections.view_geometry import stated_geometry
from beamline.reconstruct.energy_views import repeated, views_of_others
from beamline.reconstruct.error_bars import refuse_impossible
from beamline.reconstruct.needs import memory_of, needs_of, refuse_slabs, refuse_smallest, refuse_whole, surely_weighted
from beamline.reconstruct.options import ReconOptions
from beamline.storage.writers.partial_volume import slabs_of_partial
from recon.assess.time_model import duration_text
from recon.base.method import volumes_of
from recon.base.slabs import slabs_of
from recon.base.volume import Grid
from recon.base.work import Rates, Span, costs_of, parts_of, seconds_of


@dataclass(frozen=True)
class Estimate:
    """The resources of a reconstruction.

    Attributes:
        shape: of the volume [z, y, x], or of several volumes [volume, z, y, x].
        at_once: bytes of memory with everything in it.
        allowed: bytes of memory that may be used.
        memory: bytes that will be used.
        slabs: that are still to be made.
        done: slices that a partial volume has.
        scratch: bytes on the disk of the output, while it works; 0: all at once in memory.
        output, free: bytes of the result, and bytes on its disk.
        seconds: at most, without reading and correction; None: the method does not say what it computes.
        least_seconds: where the data choose what takes least; otherwise `seconds`.
    """

    method: str
    views: int
    shape: tuple[int, ...]
    at_once: int
    allowed: int
    memory: int
    slabs: int
    done: int
    scratch: int
    output: int
    free: int
    seconds: float | None
    least_seconds: float | None

    def lines(self) -> list[str]:
        in_slabs = f"in {count(self.slabs, 'slab')}; all at once would take {size(self.at_once)}"
        if self.done:
            in_slabs = f"in {count(self.slabs, 'slab')} that are left; {self.done} of {self.shape[0]} slices are there"
        how = in_slabs if self.scratch else "all at once"
        *several, z, y, x = self.shape
        what = f"{'volumes':<10}{several[0]} of " if several else f"{'volume':<10}"
        return [
            f"{what}{z} x {y} x {x} voxels by {self.method}, from {self.views} views",
            f"{'memory':<10}{size(self.memory)} of {size(self.allowed)}, {how}",
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
    """Estimate for a finished scan; for a partial volume, of the missing slabs. No frame is read, and nothing is run.

    Args:
        rates: of this machine.

    Raises:
        DataError: it does not fit into the memory or on the disk, with the option that would make it fit. Also for a
            partial volume with another number of slices.
        ConfigError: the selection does not fit the scan, or an option needs more memory than there is. Also
            for a method without error bars, where they are wanted.
    """
    if options.uncertainty:
        refuse_impossible(options)
    with options.source.open() as source:
        options = options.around_region(source)
        geometry = stated_geometry(source, options.selection)
        geometry = repeated(geometry, geometry.n_views + views_of_others(options.source, options.selection))
        allowed, needs = memory_of(options), needs_of(source, options)
        shape = Grid.matching(geometry).shape
        slabs = missing = slabs_of(shape[0], shape[0], 0)
        fits = needs.at_once <= allowed and options.partial is None
        if not fits and geometry.is_cone and not options.method.traits.several:
            raise DataError(
                f"{source.path}: {options.method.name} would take {size(needs.at_once)}, {size(allowed)} of memory may "
                "be used, and a cone is not made in slabs. Give more --memory, or --bin 2, or fewer --rows."
            )
        if not fits:
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
    heights = [slab.slices.stop - slab.slices.start for slab in missing]
    try:
        costs = costs_of(needs.method, parts_of(geometry, heights), decided=options.partial is not None)
    except ValueError as error:  # as the method itself refuses the views
        raise DataError(f"{source.path} cannot be reconstructed by {options.method.name}: {error}.") from error
    span = None if costs is None else seconds_of(costs, rates)
    if not missing:
        span = Span(0.0, 0.0)
    times = 1 + options.uncertainty  # error bars take at most as long
    done = sum(slab.own.stop - slab.own.start for slab in slabs) - sum(s.own.stop - s.own.start for s in missing)
    height = slabs[0].own.stop
    of_all = shape if (several := volumes_of(needs.method)) == 1 else (several, *shape)
    return Estimate(
        options.method.name, geometry.n_views, of_all, needs.at_once, allowed,
        needs.at_once if fits else max(needs.slab(height), needs.least), len(missing), done, scratch, output, free,
        None if span is None else times * span.most, None if span is None else times * span.least,
    )  # fmt: skip


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
