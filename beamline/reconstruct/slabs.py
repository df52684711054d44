"""FBP within a memory: views and volume lie on disk, and sixteen slices at a time in memory."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from beamline.core.errors import ConfigError, DataError
from beamline.core.events import Event, Sink
from beamline.core.machine import free_memory
from beamline.core.text import size
from beamline.projections.correction import Warn
from beamline.projections.prepare import PreparedProjections, Spill, prepare_projections
from beamline.projections.selection import choose_views, cone_of, rows_of
from beamline.reconstruct.options import ReconOptions
from beamline.storage.readers.base import ScanSource
from beamline.storage.scratch import scratch_array
from drivers.clock import Clock
from drivers.frame import FrameKind
from recon.base.method import Progress
from recon.base.volume import Grid, Volume
from recon.reconstruction import Reconstruction
from recon.voxels.direct import Fbp
from recon.voxels.fbp import fbp, fbp_memory

SHARE = 0.7
"""Of the memory that is free, what a reconstruction by FBP may take by default."""

_BATCH = 0.25  # of that, what views take while they are corrected
_COPIES = 4  # float32 copies of a view while it is corrected


@dataclass(frozen=True)
class Needs:
    """Bytes that FBP of a scan needs.

    Attributes:
        views: how many are chosen.
        shape: (rows, cols) of a view, binned.
        raw: of the pixels as they are read.
        block: of sixteen slices, their views and whatever makes them.
    """

    views: int
    shape: tuple[int, int]
    raw: int
    block: int

    @property
    def line_integrals(self) -> int:
        return 4 * self.views * self.shape[0] * self.shape[1]

    @property
    def volume(self) -> int:
        return 4 * self.shape[0] * self.shape[1] ** 2

    @property
    def at_once(self) -> int:
        """With everything in memory."""
        return self.raw + self.line_integrals + self.volume + self.block

    @property
    def view(self) -> int:
        """While one view is corrected."""
        return self.raw // self.views + _COPIES * self.line_integrals // self.views


def needs_of(source: ScanSource, options: ReconOptions) -> Needs:
    """What FBP of the views chosen needs, before any frame is read.

    Raises:
        ConfigError: the selection does not fit the scan.
    """
    selection = options.selection
    rows, frames = rows_of(source, selection), np.flatnonzero(source.image_key == FrameKind.PROJECTION)
    views = choose_views(source, frames, selection).size
    shape = (rows.stop - rows.start) // selection.binning, source.shape[1] // selection.binning
    itemsize = source.dtype.itemsize if selection.binning == 1 else 4
    return Needs(views, shape, views * shape[0] * shape[1] * itemsize, fbp_memory(views, shape[1]))


def spill_of(
    source: ScanSource, options: ReconOptions, told: Callable[[int, int], None], warn: Callable[[str], None]
) -> Spill | None:
    """Where the views go if they do not fit into the memory; None where they do, and for a cone.

    Raises:
        DataError: sixteen slices do not fit, or the disk is too full.
    """
    if not isinstance(options.method, Fbp) or cone_of(source, options.selection) is not None:
        return None
    try:
        needs = needs_of(source, options)
    except ConfigError:
        return None  # what is wrong with the views themselves comes first: reading them says it
    memory = round(SHARE * free_memory()) if options.memory is None else options.memory
    if needs.at_once <= memory:
        return None
    if needs.block + needs.view > memory:
        raise DataError(
            f"{source.path}: FBP of sixteen slices of {needs.views} views of {needs.shape[1]} columns takes "
            f"{size(needs.block + needs.view)} of memory, {size(memory)} may be used. Give --memory "
            f"{math.ceil((needs.block + needs.view) / 1e6)}M if there is as much, or --bin "
            f"{2 * options.selection.binning}. "
            "Nothing was written."
        )
    batch = max(1, int(min(_BATCH * memory, memory - needs.block) / needs.view))
    warn(
        f"All at once would take {size(needs.at_once)}, {size(memory)} of memory may be used: views and volume lie on "
        f"the disk of the output while it works, {size(needs.line_integrals + needs.volume)}."
    )
    return Spill(scratch_array(options.target.output.parent, (needs.views, *needs.shape)), batch, told)


def prepare_within(
    source: ScanSource, options: ReconOptions, sink: Sink, clock: Clock, warn: Warn
) -> tuple[PreparedProjections, bool]:
    """As `prepare_projections`, and whether line integrals lie on disk."""
    began = clock.now()

    def told(n: int, total: int) -> None:
        now = clock.now()
        rate = n / max(now - began, 1e-9)
        data = {"stage": "correction", "n": n, "of": total, "per_s": rate, "eta_s": (total - n) / rate}
        sink(Event("progress", now, data))

    def said(text: str) -> None:
        sink(Event("state", clock.now(), {"state": "memory", "message": text}))

    spill = spill_of(source, options, told, said)
    return prepare_projections(source, options.selection, warn, spill), spill is not None


def fbp_on_disk(
    method: Fbp, options: ReconOptions, prepared: PreparedProjections, listen: Callable[[Progress], None], clock: Clock
) -> Reconstruction:
    """FBP from views on disk to a volume on disk; the same as in memory to the bit."""
    geometry, grid, begin = prepared.geometry, Grid.matching(prepared.geometry), clock.now()
    volume = scratch_array(options.target.output.parent, grid.shape)

    def told(done: int, of: int) -> None:
        nan = float("nan")
        listen(Progress(done, of, clock.now() - begin, nan, nan, 0, geometry.n_views, unit="slices"))

    fbp(prepared.projections.data, geometry, grid, method.filter, told, volume)
    settings = {"filter": method.filter}
    return Reconstruction(Volume(volume, grid), clock.now() - begin, (), method.name, None, settings)
