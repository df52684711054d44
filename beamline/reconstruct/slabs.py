"""Slabs: the parts in which a scan too large for the memory is reconstructed, and the memory of each."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from beamline.core.errors import ConfigError, DataError
from beamline.core.events import Counted, Sink, StateEntered
from beamline.core.machine import free_memory
from beamline.core.machine_speed import seconds_left
from beamline.core.phases import Phases
from beamline.core.sinks import Warn
from beamline.core.text import count, size
from beamline.projections.corrections.calibrate import Calibrate
from beamline.projections.corrections.poses import stated_poses
from beamline.projections.corrections.resampling import TiltAndLens
from beamline.projections.prepare import DiskBuffer, prepare_projections
from beamline.projections.prepared import PreparedProjections
from beamline.projections.protocols import ScanPart
from beamline.projections.registry import in_order
from beamline.projections.selection import choose_views, cone_of, rows_of
from beamline.projections.step import StepMemory
from beamline.reconstruct.cluster import local_workers
from beamline.reconstruct.options import ReconOptions
from beamline.reconstruct.region import locate
from beamline.reconstruct.slurm import is_slurm, slurm_jobs
from beamline.storage.readers.base import ScanSource
from beamline.storage.scratch import scratch_array
from beamline.storage.writers.partial_volume import slabs_of_partial
from drivers.base.clock import Clock
from drivers.base.frame import FrameKind
from recon.base.arrays import F64, I64
from recon.base.geometry import Geometry
from recon.base.method import DividedMethod, Method, candidates_of, volumes_of
from recon.base.slabs import Slab, slabs_of
from recon.base.volume import Grid
from recon.error_bars import HALO, error_bars_memory
from recon.voxels.direct import Fbp
from recon.voxels.odd_views import odd_views_memory
from recon.voxels.stray_mass import stray_mass_memory
from recon.voxels.unexplained import unexplained_memory

SHARE = 0.7  # Share of the free memory that a reconstruction takes by default

_BATCH = 0.25  # share of it for views during correction
_COPIES = 4  # float32 copies of a view while it is corrected
_ROWS = 16  # slices: FBP makes so many together, and slabs are multiples of it
_REGIONS, _REGION = 2**21, 12  # voxels at most of the regions that judge volumes (`metrics.sampled`); bytes of a voxel
_NO_STEPS = StepMemory()
_EMISSION = 6 * 4  # bytes a pixel: counts, survival, background and weights, and what they are made of
_ASIDE = 64_000_000  # bytes of figures, and of steps that are alone, that are not counted


@dataclass(frozen=True)
class Needs:
    """Bytes that a reconstruction needs.

    Attributes:
        geometry: of the views, binned; before any is read, one that is alike.
        raw: of the pixels as they are read.
        steps: bytes that the steps of the correction take.
        largest_step: name of the one that takes the most alone.
        bars: error bars are made, too.
    """

    method: Method
    geometry: Geometry
    raw: int
    weighted: bool
    steps: StepMemory = _NO_STEPS
    largest_step: str = ""
    bars: bool = False

    @classmethod
    def of(
        cls, method: Method, views: int, shape: tuple[int, int], itemsize: int, axis_col: float | None = None
    ) -> Needs:
        """Before any frame is read: of so many views [row, col], bytes of a pixel, and the axis where it is known."""
        alike = Geometry.parallel(np.linspace(0, math.pi, views, endpoint=False), shape, axis_col=axis_col)
        return cls(method, alike, views * math.prod(shape) * itemsize, not method.traits.direct)

    @property
    def rows(self) -> int:
        return self.geometry.detector_shape[0]

    @property
    def line_integrals(self) -> int:
        return 4 * self.geometry.n_views * math.prod(self.geometry.detector_shape)

    @property
    def volume(self) -> int:
        """Of the result, which may be several volumes."""
        return 4 * volumes_of(self.method) * math.prod(Grid.matching(self.geometry).shape)

    @property
    def at_once(self) -> int:
        """With everything in memory."""
        work = self._work(self.method, self.geometry, self._grid(self.rows))
        return self.raw + self.line_integrals + max(work, self.steps.correcting, self._alone)

    @property
    def _alone(self) -> int:
        """A step that is alone in memory, beyond the program's own."""
        return self.steps.alone if self.steps.alone > _ASIDE else 0

    @property
    def view(self) -> int:
        """While one view is corrected."""
        return (self.raw + _COPIES * self.line_integrals) // self.geometry.n_views

    def slab(self, height: int) -> int:
        """A slab of so many slices of its own, with its views and weights; figures of the volume need less."""
        halo = self.method.traits.halo
        seen = min(height + 2 * (max(halo, HALO) if self.bars else halo), self.rows)
        part = self.geometry.rows(0, seen)
        rays = (1 + self.weighted) * 4 * part.n_views * math.prod(part.detector_shape)
        return rays + self._work(for_part(self.method, seen, self.rows, self.rows), part, self._grid(seen))

    def _work(self, method: Method, geometry: Geometry, grid: Grid) -> int:
        """The method, or its error bars beside its volume."""
        work = method.memory(geometry, grid, self.weighted)
        if not self.bars:
            return work
        bars = max(error_bars_memory(candidate, geometry, grid) for candidate in candidates_of(method))
        return max(work, 4 * math.prod(grid.shape) + bars)

    @property
    def figures(self) -> int:
        """The figures of merit of a volume on disk, beyond the program's own memory; FBP needs less."""
        odd = 0 if self.method.traits.direct else odd_views_memory(self.geometry)
        looks = unexplained_memory(self.geometry), stray_mass_memory(self.geometry, Grid.matching(self.geometry))
        most = max(odd, _REGION * min(math.prod(Grid.matching(self.geometry).shape), _REGIONS), *looks)
        return most if most > _ASIDE else 0

    @property
    def least(self) -> int:
        """The least memory that suffices."""
        return max(self.parts.values())

    @property
    def parts(self) -> dict[str, int]:
        """Bytes of each part that must fit alone, by what an error calls it."""
        views = f"{self.geometry.n_views} views of {self.geometry.detector_shape[1]} columns"
        return {
            f"{self.method.name} of the smallest slab of {views}{' with weights' * self.weighted}": self.slab(_ROWS),
            "the correction of a view": self.view + self.steps.correcting,
            f"the step {self.largest_step}": self._alone,
            "the measurement of the volume": self.figures,
        }

    def height(self, memory: int) -> int:
        """Slices of the largest slabs for which the memory suffices, evenly; `least` must."""
        for parts in range(1, self.rows // _ROWS + 2):
            height = math.ceil(self.rows / parts / _ROWS) * _ROWS
            if self.slab(height) <= memory:
                return height
        return _ROWS

    def _grid(self, rows: int) -> Grid:
        return Grid((rows, *Grid.matching(self.geometry).shape[1:]), self.geometry.sample_pitch)


def for_part(method: Method, slices: int, of: int, in_all: int) -> Method:
    """The method for so many slices `of` a volume; slabs, with the slices that they share, have so many `in_all`."""
    return method.for_part(slices / of, slices / in_all) if isinstance(method, DividedMethod) else method


def needs_of(source: ScanSource, options: ReconOptions) -> Needs:
    """The needs of a reconstruction of the chosen views, before any frame is read.

    Raises:
        ConfigError: the selection does not fit the scan.
    """
    selection = options.selection
    rows, frames = rows_of(source, selection), np.flatnonzero(source.image_key == FrameKind.PROJECTION)
    views = choose_views(source, frames, selection).size
    shape = (rows.stop - rows.start) // selection.binning, source.shape[1] // selection.binning
    axis = source.axis_col if selection.axis_col is None else selection.axis_col
    if axis is not None:
        axis = (axis - (selection.binning - 1) / 2) / selection.binning
    pixel = source.dtype.itemsize if selection.binning == 1 else 4
    pixel = pixel if source.emission is None else _EMISSION
    needs = Needs.of(options.method, views, shape, pixel, axis)
    part = ScanPart(source, selection, needs.geometry)
    stated = {step.name: step.memory(part) for step in in_order(selection)}
    return replace(
        needs,
        method=options.method_for(needs.geometry),
        steps=StepMemory.of_all(stated.values()),
        largest_step=max(stated, key=lambda name: stated[name].alone),
        bars=options.uncertainty,
    )


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
        needs = needs_of(source, options)
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


def surely_weighted(source: ScanSource, options: ReconOptions) -> bool:
    """Whether it is known before reading that rays have weights, as of turned views."""
    turned = options.selection.step(TiltAndLens).of(source, options.selection) is not None
    return turned and not options.method.traits.direct


def memory_of(options: ReconOptions) -> int:
    """Bytes that this process may use, and each worker on this machine or job of Slurm."""
    if options.memory is not None:
        return options.memory
    if options.cluster is not None and is_slurm(options.cluster):
        return round(SHARE * min(free_memory(), slurm_jobs(options.cluster).bytes))
    return round(SHARE * free_memory() / (1 + local_workers(options.cluster)))


def refuse_whole(source: ScanSource, options: ReconOptions, needs: Needs, memory: int) -> None:
    """Raises ConfigError for a method and for options that need everything in memory."""
    if options.method.traits.in_time:
        fewer = int(needs.rows * memory / needs.at_once)
        rows = f"--rows with {count(fewer, 'row')} or fewer at a time, or " if fewer else ""
        raise ConfigError(
            f"{count(volumes_of(options.method), 'volume')} in time of {Grid.matching(needs.geometry).shape} voxels "
            f"take {size(needs.at_once)} of memory, {size(memory)} may be used. Volumes in time are not made in slabs: "
            f"give {rows}--bin. Nothing was written."
        )
    poses = stated_poses(source, options.selection)
    whole = {
        "--calibrate with roll or tilt": options.selection.step(Calibrate).may_lean,
        "--poses with roll or tilt": poses is not None and bool(poses.turns_deg.any()),
        "--budget": options.budget is not None,
        "--checkpoint and --resume": options.checkpoints.wanted,
        "--early-stop": options.stops_early,
    }
    for option, given in whole.items():
        if given:
            raise ConfigError(
                f"{option} needs the whole scan in memory: {source.path} takes {size(needs.at_once)}, {size(memory)} "
                f"may be used. Leave it out, or give --bin {2 * options.selection.binning} or --rows."
            )


def refuse_smallest(source: ScanSource, needs: Needs, memory: int, binning: int) -> None:
    """Raises DataError if the smallest slab does not fit, with a remedy."""
    if needs.least <= memory:
        return
    cheaper = replace(needs, method=Fbp(), weighted=False).least <= memory
    raise DataError(
        f"{source.path}: {max(needs.parts, key=needs.parts.__getitem__)} takes {size(needs.least)} of memory, "
        f"{size(memory)} may be used. Give --memory {math.ceil(needs.least / 1e6)}M if there is as much, "
        f"or --bin {2 * binning}{', or -m fbp' if cheaper else ''}. Nothing was written."
    )


def refuse_slabs(path: Path, slabs: Sequence[Slab], needs: Needs, memory: int) -> None:
    """Raises DataError if the slabs of a partial volume do not fit."""
    if (wanted := needs.slab(slabs[0].own.stop)) > memory:
        raise DataError(
            f"The slabs of {path} take {size(wanted)} of memory, {size(memory)} may be used. Give --memory "
            f"{math.ceil(wanted / 1e6)}M if there is as much. Nothing was touched."
        )


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

    def check(geometry: Geometry) -> None:
        if options.region is not None:
            locate(options.region, options.selection, geometry)
        if options.method.traits.in_time and (needs := Needs(options.method, geometry, 0, True)).at_once > memory:
            refuse_whole(source, options, needs, memory)
        if buffer is not None and not geometry.is_straight:
            raise DataError(
                f"{source.path}: its views are rolled or tilted, and a volume in slabs takes rows for slices. "
                "The whole scan has to be in memory: give more --memory, or --bin 2, or fewer --rows."
            )

    prepared = prepare_projections(source, options.selection, warn, buffer, check, phases)
    geometry, method = prepared.geometry, options.method_for(prepared.geometry)
    if method.traits.in_time:
        prepared = replace(prepared, times=times_of(source, prepared.projections.view_ids, warn))
    if buffer is None:
        if options.partial is not None:
            raise DataError(f"{options.partial} holds slabs, and {source.path} is a cone, which is not made in slabs.")
        needs = Needs(method, geometry, 0, not method.traits.direct, bars=options.uncertainty)
        _refuse_wider(source, prepared, needs, memory)
        return prepared, []
    weighted = not method.traits.direct and (prepared.ray_factors() is not None or prepared.shares_of is not None)
    needs = Needs(method, geometry, 0, weighted, bars=options.uncertainty)
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


def _refuse_wider(source: ScanSource, prepared: PreparedProjections, needs: Needs, memory: int) -> None:
    """Raises DataError if a volume does not fit after all, because its axis was found near an edge."""
    if needs.geometry.is_cone or prepared.axis is None or needs.at_once <= memory:
        return
    raise DataError(
        f"{source.path}: the rotation axis was found at column {prepared.axis_col:.2f}, off the middle, and the volume "
        f"that a full turn sees takes {size(needs.at_once)} of memory, {size(memory)} may be used. Give "
        f"--axis {prepared.axis_col:.2f}, so that it is made in slabs. Nothing was written."
    )
