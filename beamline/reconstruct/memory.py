"""Memory: how much of it a reconstruction needs, in one piece and in slabs; errors if it is too much; remote
workers.
"""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Any

from beamline.core.errors import ConfigError, DataError
from beamline.core.machine import free_memory
from beamline.core.text import count, size
from beamline.projections.corrections.poses import stated_poses
from beamline.projections.protocols import ScanPart
from beamline.projections.registry import geometry_steps, in_order
from beamline.projections.selection import SelectedScan
from beamline.projections.step import StepMemory
from beamline.projections.views import stated_geometry
from beamline.reconstruct.options import ReconOptions
from beamline.storage.readers.base import ScanSource
from recon.base.geometry import Geometry
from recon.base.method import Method
from recon.base.reach import Reach
from recon.base.registry import add_on_missing, plugins
from recon.base.volume import Grid
from recon.error_bars import HALO, error_bars_memory
from recon.judgement import judge_memory
from recon.voxels.direct import Fbp

SHARE = 0.7  # default share of the free memory that a reconstruction may use

_COPIES = 4  # number of float32 copies of a projection while it is corrected
_ROWS = 16  # number of slices that FBP makes together; the height of slabs is a multiple of it
_NO_STEPS = StepMemory()
_ASIDE = 64_000_000  # bytes that are not counted, for figures of merit or for a step that runs alone


@dataclass(frozen=True)
class ReconMemory:
    """Memory of a reconstruction in bytes.

    Attributes:
        geometry: geometry of the binned projections of all scans.
        raw: memory of the pixels as they are read.
        steps: memory of the correction steps.
        largest_step: name of the step that needs the most memory when it runs alone.
        bars: True if error bars are computed, too.
        reach: how far the sample goes beyond the field of view, for a method that reconstructs all of it; None: it is
            within the field of view.
        weights: memory of the ray weights that stay in memory together with the line integrals.
    """

    method: Method
    geometry: Geometry
    raw: int
    weighted: bool
    steps: StepMemory = _NO_STEPS
    largest_step: str = ""
    bars: bool = False
    reach: Reach | None = None
    weights: int = 0

    @property
    def rows(self) -> int:
        return self.geometry.detector_shape[0]

    @property
    def line_integrals(self) -> int:
        return 4 * self.geometry.n_views * math.prod(self.geometry.detector_shape)

    @property
    def volume(self) -> int:
        """Memory of the result, which may be several volumes."""
        return 4 * self.method.volumes * math.prod(Grid.matching(self.geometry).shape)

    @property
    def at_once(self) -> int:
        """Memory if the volume and all projections are in memory at once."""
        work = self._work(self.method, self.geometry, self._grid(self.rows))
        return self.raw + self.line_integrals + self.weights + max(work, self.steps.correcting, self._alone)

    @property
    def _alone(self) -> int:
        """Memory of a step that runs alone; 0 if it is less than `_ASIDE`, which is not counted."""
        return self.steps.alone if self.steps.alone > _ASIDE else 0

    @property
    def view(self) -> int:
        """Memory while one projection is corrected."""
        return (self.raw + _COPIES * self.line_integrals) // self.geometry.n_views

    def slab(self, height: int) -> int:
        """Memory of a slab of `height` slices, with its projections and weights. Figures of merit of a slab need
        less.
        """
        halo = self.method.halo
        n_rows = min(height + 2 * (max(halo, HALO) if self.bars else halo), self.rows)
        part = self.geometry.rows(0, n_rows)
        rays = (1 + self.weighted) * 4 * part.n_views * math.prod(part.detector_shape)
        work = self._work(self.method.for_part(n_rows / self.rows, n_rows / self.rows), part, self._grid(n_rows))
        return self.weights + rays + work

    def _work(self, method: Method, geometry: Geometry, grid: Grid) -> int:
        """Memory of the method, or of its error bars together with its volume."""
        work = method.memory(geometry, grid, self.weighted)
        if not self.bars:
            return work
        bars = max(error_bars_memory(candidate, geometry, grid) for candidate in method.alternatives)
        return max(work, 4 * math.prod(grid.shape) + bars)

    @property
    def figures(self) -> int:
        """Memory of the figures of merit for a volume on disk; 0 if it is less than `_ASIDE`, which is not counted. FBP
        needs less.
        """
        judge_bytes = judge_memory(self.geometry, fitted=self.method.fitted)
        return judge_bytes if judge_bytes > _ASIDE else 0

    @property
    def least(self) -> int:
        """The smallest memory that suffices."""
        return max(self.parts.values())

    @property
    def parts(self) -> dict[str, int]:
        """Bytes of each part of the work that must fit into the memory alone, by the name of the part in an error."""
        views = f"{self.geometry.n_views} projections of {self.geometry.detector_shape[1]} columns"
        return {
            f"{self.method.name} of the smallest slab of {views}{' with weights' * self.weighted}": self.slab(_ROWS),
            "the correction of a projection": self.view + self.steps.correcting,
            f"the step {self.largest_step}": self._alone,
            "the check of the volume": self.figures,
        }

    def height(self, memory: int) -> int:
        """Height of the largest slabs of equal height that fit into `memory`. `memory` must be at least `least`."""
        for parts in range(1, self.rows // _ROWS + 2):
            height = math.ceil(self.rows / parts / _ROWS) * _ROWS
            if self.slab(height) <= memory:
                return height
        return _ROWS

    def _grid(self, rows: int) -> Grid:
        grid = Grid((rows, *Grid.matching(self.geometry).shape[1:]), self.geometry.sample_pitch)
        return grid if self.reach is None else self.reach.box(grid, self.geometry)


def recon_memory_of(scan: SelectedScan, options: ReconOptions) -> ReconMemory:
    """The memory to reconstruct the selected projections of a scan, estimated before any frame is read.

    Raises:
        ConfigError: the selection does not fit the scan.
        DataError: the poses do not fit the scan.
    """
    method, geometry = options.method, stated_geometry(scan)
    pixel = scan.source.dtype.itemsize if scan.selection.binning == 1 else 4
    part = ScanPart(scan, geometry)
    stated = {step.name: step.memory(part) for step in in_order(scan.selection)}
    return ReconMemory(
        options.method_for(geometry),
        geometry,
        geometry.n_views * math.prod(geometry.detector_shape) * pixel,
        method.weighs,
        StepMemory.of_all(stated.values()),
        max(stated, key=lambda name: stated[name].alone),
        options.uncertainty,
    )


def allowed_memory(memory: int | None, workers: str | None) -> int:
    """Memory in bytes that this process may use, and that each worker on this computer or in the Slurm job may use.

    Args:
        memory: bytes that the user allows; None: a share of the free memory.
        workers: the workers that reconstruct slabs, in the form of `--cluster`; None: there are none.
    """
    if memory is not None:
        return memory
    free = free_memory()
    return round(SHARE * free / (1 + local_workers(workers)))


def refuse_several(needs: ReconMemory, memory: int) -> None:
    """Raise ConfigError if several volumes do not fit into the memory together."""
    n_volumes = needs.method.volumes
    if n_volumes > 1 and needs.at_once > memory:
        fewer = int(needs.rows * memory / needs.at_once)
        rows = f"--rows with {count(fewer, 'row')} or fewer at a time, or " if fewer else ""
        raise ConfigError(
            f"Use {rows}--bin, because a time series cannot be reconstructed in slabs: {n_volumes} volumes, each of "
            f"{Grid.matching(needs.geometry).shape} voxels, need {size(needs.at_once)} of memory, but {size(memory)} "
            "is allowed. Nothing was written."
        )


def refuse_whole(scan: SelectedScan, needs: ReconMemory, memory: int, *, checkpoints: bool) -> None:
    """Raise ConfigError if the method or an option needs everything in memory. checkpoints: True if the user gave a
    checkpoint to write or to resume from.
    """
    poses, selection = stated_poses(scan), scan.selection
    whole = {
        **{f"{step.requested_by} with roll or tilt": step.may_roll_or_tilt for step in geometry_steps(selection)},
        "--poses with roll, tilt or vectors": poses is not None and poses.leans,
        "--checkpoint and --resume": checkpoints,
        "--early-stop": needs.method.stops_early,
    }
    for option, used in whole.items():
        if used:
            larger_bin = 2 * selection.binning
            raise ConfigError(
                f"{option} needs the whole scan in memory: {scan.source.path} needs {size(needs.at_once)}, but "
                f"{size(memory)} is allowed. Leave out this option, or use --bin {larger_bin} "
                "or --rows."
            )


def refuse_smallest(source: ScanSource, needs: ReconMemory, memory: int, binning: int) -> None:
    """Raise DataError, with a remedy, if the smallest slab does not fit."""
    if needs.least <= memory:
        return
    cheaper = replace(needs, method=Fbp(), weighted=False).least <= memory
    largest_part = max(needs.parts, key=needs.parts.__getitem__)
    needed_mb = math.ceil(needs.least / 1e6)
    larger_bin = 2 * binning
    or_fbp = ", or -m fbp" if cheaper else ""
    raise DataError(
        f"{source.path}: {largest_part} needs {size(needs.least)} of memory, but {size(memory)} is allowed. Use "
        f"--memory {needed_mb}M if the computer has this much memory, or --bin {larger_bin}{or_fbp}. Nothing was "
        "written."
    )


def cluster(spec: str) -> AbstractContextManager[Any]:
    """Workers of the add-on splatline-cluster that reconstruct slabs: a context manager with `workers` and
    `reconstruct`.

    Args:
        spec: `local:N` for N workers on this machine, or `tcp://HOST:PORT` of a scheduler.

    Raises:
        ConfigError: the add-on is not installed.
    """
    workers = plugins("workers", ())
    if "cluster" not in workers:
        raise ConfigError(f"--cluster {add_on_missing('cluster')}. Nothing was read.")
    connected: AbstractContextManager[Any] = workers["cluster"](spec)
    return connected


def local_workers(spec: str | None) -> int:
    """Number of workers to start on this machine; 0 if a scheduler has its own workers, or if there is no cluster."""
    return int(spec.removeprefix("local:")) if spec is not None and spec.startswith("local:") else 0
