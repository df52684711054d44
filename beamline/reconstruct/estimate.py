"""Estimates memory, time and disk space of a reconstruction before it starts."""

from __future__ import annotations

import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass

from beamline.core.errors import DataError
from beamline.core.machine import Need
from beamline.core.text import count, size
from beamline.projections.prepare import require_usable
from beamline.projections.selection import SelectedScan, check_axis
from beamline.projections.views import select
from beamline.reconstruct.memory import recon_memory_of
from beamline.reconstruct.options import ReconOptions
from beamline.reconstruct.plan import planned
from beamline.reconstruct.refusals import refuse_before_reading
from beamline.reconstruct.truth import fit_truth
from recon.assess.time_model import duration_text
from recon.base.geometry import Geometry
from recon.base.method import Clock, Method
from recon.base.slabs import Slab, slabs_of
from recon.base.volume import Grid
from recon.forecast import forecast
from recon.warm_up import warm_up


@dataclass(frozen=True, kw_only=True)
class Estimate(Need):
    """Estimated time, memory and disk space of a reconstruction. The seconds do not include reading and correction.
    `scratch` is 0 if the reconstruction runs in memory.

    Attributes:
        shape: shape of the volume [z, y, x], or of several volumes [volume, z, y, x].
        at_once: bytes of memory that the reconstruction needs if everything is in memory.
        allowed: bytes of memory that may be used.
        slabs: number of slabs that are not yet reconstructed.
        done: number of slices that a partial volume already has.
        free: free bytes on the disk of the output.
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
        in_slabs = f"in {count(self.slabs, 'slab')}; a volume in one piece would need {size(self.at_once)}"
        if self.done:
            n_slices = self.shape[0]
            in_slabs = f"in {count(self.slabs, 'slab')} remaining; {self.done} of {n_slices} slices are done"
        slabs_text = in_slabs if self.scratch else "all at once"
        *several, z, y, x = self.shape
        volumes_text = f"{'volumes':<10}{several[0]} of " if several else f"{'volume':<10}"
        return [
            f"{volumes_text}{z} x {y} x {x} voxels with {self.method}, from {self.views} projections",
            f"{'memory':<10}{size(self.memory or 0)} of {size(self.allowed)}, {slabs_text}",
            f"{'disk':<10}{size(self.output)} for the result, {size(self.scratch)} for temporary files; "
            f"{size(self.free)} free",
            f"{'time':<10}{self._time()}",
        ]

    def _time(self) -> str:
        if self.seconds is None or self.least_seconds is None:
            return f"not known, because the time of {self.method} cannot be predicted"
        most_text, least_text = (f"about {duration_text(seconds)}" for seconds in (self.seconds, self.least_seconds))
        early = f"{most_text}; {least_text} if the method ends early with these data"
        span = early if self.least_seconds < self.seconds else most_text
        return f"{span}; reading and correction not counted"


def estimate(options: ReconOptions, now: Clock = time.perf_counter) -> Estimate:
    """Estimate a reconstruction of a finished scan; for a partial volume, estimate the missing slabs. The method runs
    for a few iterations on simulated views. Frames are read only to find a region around the sample.

    Raises:
        DataError: the reconstruction does not fit into the memory or on the disk; the message names the option that
            would make it fit. A partial volume has another number of slices.
        ConfigError: the selection does not fit the scan, or an option needs more memory than there is. The estimate
            also raises all other errors that the reconstruction raises before it reads a frame.
    """
    truth = refuse_before_reading(options)
    with options.source.open() as source:
        options, scan = options.around_region(select(source, options.selection))
        _refuse_scan(scan)
        needs = recon_memory_of(scan, options)
        if truth is not None:
            fit_truth(truth, Grid.matching(needs.geometry), options.selection.binning)
        plan = planned(scan, options, needs)
    method, geometry = plan.needs.method, plan.needs.geometry
    options.target.require_room(plan.output, plan.scratch)
    shape, several = Grid.matching(geometry).shape, method.volumes
    missing = plan.missing if plan.slabs else slabs_of(shape[0], shape[0], 0)
    span = _seconds(options, method, geometry, missing, now)
    return Estimate(
        method=options.method.name,
        views=geometry.n_views,
        shape=shape if several == 1 else (several, *shape),
        at_once=needs.at_once,
        allowed=plan.allowed,
        memory=plan.memory,
        slabs=len(missing),
        done=_slices(plan.slabs) - _slices(plan.missing),
        scratch=plan.scratch,
        output=plan.output,
        free=shutil.disk_usage(options.target.output.parent).free,
        seconds=None if span is None else span[1],
        least_seconds=None if span is None else span[0],
    )


def _slices(slabs: Sequence[Slab]) -> int:
    return sum(slab.own.stop - slab.own.start for slab in slabs)


def _seconds(
    options: ReconOptions, method: Method, geometry: Geometry, missing: Sequence[Slab], now: Clock
) -> tuple[float, float] | None:
    """The shortest and the longest time in s for these slabs; None if the times are not known before the method is
    tried.
    """
    if not missing:
        return 0.0, 0.0
    grid = Grid.matching(geometry)
    try:
        for candidate in method.alternatives:
            warm_up(candidate, geometry)
        expected = forecast(method, geometry, grid, now)
    except ValueError as error:  # the method would refuse the views in the same way
        raise DataError(f"{options.source.path} cannot be reconstructed by {method.name}: {error}") from error
    if expected is None:
        return None
    choice = 0.0 if options.partial is not None else expected.choice_seconds  # a partial volume already has the choice
    # the sum counts the overlap of slabs twice
    share = sum(slab.slices.stop - slab.slices.start for slab in missing) / grid.shape[0]
    bars = 1 + options.uncertainty  # the error bars take at most as long as the volume
    least_seconds, most_seconds = (bars * (choice + share * each(expected.volumes.values())) for each in (min, max))
    return least_seconds, most_seconds


def _refuse_scan(scan: SelectedScan) -> None:
    """Raise the ConfigErrors and DataErrors that the reconstruction raises before it reads a frame."""
    require_usable(scan)
    for axis in (scan.selection.axis_col, scan.source.axis_col if scan.selection.cone is None else None):
        if axis is not None:
            check_axis(scan.source, axis)
